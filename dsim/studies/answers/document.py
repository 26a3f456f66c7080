"""A reference problem as data: what a program in any language needs to repeat it, and what it must find.

A document is a dict of texts, numbers and arrays; README.md beside this file says what each entry means.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.scenes.pendulum import GRAVITY
from dsim.system import System

Document = dict[str, Any]

SI = {"time": "s", "position": "m", "velocity": "m/s", "mass": "kg"}

MOTION = (
    "y = [q, v]: all positions, point after point, then all velocities",
    "dq/dt = v and m_i dv_i/dt = f_i, the sum of the forces below; pinned points do not move, their velocity is 0",
)

FORCES = {
    "gravity": "gravity: f_i = m_i g, g = acceleration",
    "drag": "drag: f_i = -c_i (v_i - w), c = coefficient (one number for all points, or one a point), w = wind or 0",
    "springs": "springs: for every pair (i, j), e = x_j - x_i, l = |e|: f_i = k (l - l0) e/l and f_j = -f_i",
    "spring_damping": "spring damping: for every pair (i, j), n = e/l: f_i = c ((v_j - v_i) . n) n and f_j = -f_i",
    "actuation": "actuation: f_i = forces[n][i] during step n, the step from t_n to t_{n+1}",
    "sine": "swing: f = -strength sin(q)",
    "inverse_square": "sun: f_i = -strength x_i/|x_i|^3",
}

# A Field is code; what it computes is said here, by the name of the effect.
FIELDS: dict[str, dict[str, Any]] = {
    "swing": {"type": "sine", "strength": GRAVITY},
    "sun": {"type": "inverse_square", "strength": 1.0},
}

NUMBERS: tuple[tuple[type, str, tuple[str, ...]], ...] = (
    (Gravity, "gravity", ("acceleration",)),
    (Drag, "drag", ("coefficient", "wind")),
    (Springs, "springs", ("pairs", "rest_length", "stiffness")),
    (SpringDamping, "spring_damping", ("pairs", "coefficient")),
    (Actuation, "actuation", ("forces",)),
)


@dataclass(frozen=True, eq=False)
class Item:
    """A reference problem that can be exported.

    unknowns: length of y.  parameters: numbers in the gradient beside y0.  duration: in words.  tolerance: bounds that
    the certificates of (states, gradient) must meet.  source: of the certificate, in a few words.  build: -> document.
    """

    name: str
    unknowns: int
    parameters: int
    duration: str
    tolerance: tuple[float, float]
    source: str
    build: Callable[[], Document]


def header(name: str, kind: str, description: str, units: Mapping[str, str] = SI) -> Document:
    """The first entries of every document."""
    return {
        "format": "dsim-reference",
        "schema_version": 1,
        "name": name,
        "kind": kind,
        "description": description,
        "units": dict(units),
    }


def system_data(system: System) -> Document:
    """Points, pins and effects as numbers.  Raises ValueError for an effect that is code nobody stated a formula of."""
    effects = {effect.name: effect_data(effect) for effect in system.effects}
    return {
        "points": len(system.mass),
        "dimension": system.dimension,
        "fixed": np.array(system.fixed, dtype=np.int64),
        "mass": system.mass,
        "effects": effects,
    }


def effect_data(effect: Any) -> Document:
    """An effect's type and its numbers."""
    if isinstance(effect, Field) and effect.name in FIELDS:
        return FIELDS[effect.name]
    for kind, label, names in NUMBERS:
        if isinstance(effect, kind):
            values = {name: getattr(effect, name) for name in names if getattr(effect, name) is not None}
            if not any(callable(value) for value in values.values()):
                return {"type": label, **values}
    raise ValueError(f"effects must be numbers to be exported; {effect.name!r} ({type(effect).__name__}) is code")


def equations(system: Document) -> list[str]:
    """What is solved, line by line."""
    return [*MOTION, *(FORCES[effect["type"]] for effect in system["effects"].values())]


def objective(at: Any, linear: Array, quadratic: Array) -> Document:
    """J, a sum over the sampled states of the indices `at` (K,); linear and quadratic (K,ny)."""
    formula = "J = sum over k and i of linear[k][i] z[k][i] + quadratic[k][i] z[k][i]^2 / 2, with z[k] = states[at[k]]"
    return {"formula": formula, "at": np.array(at, dtype=np.int64), "linear": linear, "quadratic": quadratic}


def value_of(objective: Mapping[str, Any], states: Array) -> float:
    """J of sampled states (T,ny)."""
    z = states[objective["at"]]
    return float((objective["linear"] * z + objective["quadratic"] * z**2 / 2).sum())


def evidence(how: str, agreement: float) -> Document:
    """One reason to believe an answer: who was asked, and how far apart the answers were."""
    return {"how": how, "agreement": float(agreement)}


def certified(document: Document) -> Document:
    """The document, if its certificates meet its own tolerances; ArithmeticError if they do not."""
    for part in ("states", "gradient"):
        found, allowed = agreement(document, part), float(np.min(document["tolerance"][part]))
        if not found <= allowed:
            raise ArithmeticError(f"{document['name']}: {part} are certified to {found:.1e} only, must be {allowed:g}")
    return document


def agreement(document: Mapping[str, Any], part: str) -> float:
    """How well states or gradient are known: the first piece of evidence counts, what follows is weaker."""
    return float(document["certificate"][part][0]["agreement"])


def numbers(document: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, NDArray[Any]]]:
    """Every number and array with its path, joined by dots: ("answer.gradient.y0", ...)."""
    for key, value in document.items():
        if isinstance(value, Mapping):
            yield from numbers(value, f"{path}{key}.")
        elif isinstance(value, np.ndarray | float | int):
            kind = "<i8" if np.issubdtype(np.asarray(value).dtype, np.integer) else "<f8"
            yield f"{path}{key}", np.array(value, dtype=kind, order="C")
