"""What showcases have in common: a row of the catalog, progress, and variables of one's own choice."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dsim.arrays.checks import Array
from dsim.gradients.optimisation import Optimisation
from dsim.studies.check import Check

Report = Callable[[int, int, str], None]  # (done, total, what is being done)
Fit = Callable[[Any], tuple[float, Array]]  # p -> (value, gradient)


class Success(Protocol):
    """What a showcase returns: the way there, and what was reached, held against stated bounds."""

    @property
    def optimisation(self) -> Optimisation: ...

    def checks(self) -> tuple[Check, ...]: ...


@dataclass(frozen=True, eq=False)
class Showcase:
    """A row of `catalog.SHOWCASES`.  statement: one line.  run(quick, report) -> Success; draw: result -> Figure.

    quick takes two seconds or less, the full one half a minute at most.
    """

    name: str
    statement: str
    run: Callable[..., Any]
    draw: Callable[[Any], Any]


def select(rows: Sequence[Showcase], name: str) -> Showcase:
    """The showcase of this name; ValueError with suggestions for a name nobody knows."""
    known = {row.name: row for row in rows}
    if name not in known:
        close = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
        hint = f"; did you mean {' or '.join(close)}?" if close else ""
        raise ValueError(f"NAME must be one of {', '.join(known)}; got {name!r}{hint}")
    return known[name]


@dataclass(frozen=True, eq=False)
class Turned:
    """z -> O(offset + M z) and its gradient M^T dO/dp.  matrix M (k,m), dense or sparse, offset (k,)."""

    fit: Fit
    matrix: Any
    offset: Array

    def at(self, z: Any) -> Array:
        """p (k,)."""
        p: Array = self.offset + self.matrix @ np.asarray(z, dtype=float)
        return p

    def __call__(self, z: Any) -> tuple[float, Array]:
        value, gradient = self.fit(self.at(z))
        return value, self.matrix.T @ gradient


def slope_error(fit: Fit, z: Array, step: float = 1e-4, seed: int = 0) -> float:
    """How far the gradient is from a central difference along one random direction, relative to the difference.

    A gradient of the wrong sign gives 2.
    """
    direction = np.random.default_rng(seed).normal(size=len(z))
    direction /= np.linalg.norm(direction)
    difference = (fit(z + step * direction)[0] - fit(z - step * direction)[0]) / (2 * step)
    return abs(float(fit(z)[1] @ direction) - difference) / max(abs(difference), 1e-300)


def telling(report: Report | None, total: int, what: str) -> Callable[[int, float, float], None] | None:
    """A report for `optimise`: evaluations of at most about `total`, with the value."""
    if report is None:
        return None
    return lambda evaluation, value, slope: report(min(evaluation, total), total, f"{what}: {value:.2e}")
