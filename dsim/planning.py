"""Which effect runs where, and why the rest does not.

The data of the scene chooses: a plan looks at it once, before the first step, and `simulate` follows it.  No flag is
tested inside a step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dsim.arrays.checks import Array, as_array, as_step
from dsim.effects.effect import current
from dsim.effects.rows import has_rows
from dsim.solve.linear import DENSE_SIZE
from dsim.steppers import body_run
from dsim.steppers.checkpoints import Checkpoints
from dsim.steppers.explicit_run import applies
from dsim.steppers.stepper import FACTOR_BYTES, Counters, Ode, Stepper
from dsim.system import System

if TYPE_CHECKING:
    from dsim.solve.band import Band

WANTS = ("gradient",)


DERIVATIVES = ("dq", "dv", "dtheta")


@dataclass(frozen=True)
class Line:
    """One stage: on, idle or off; what it is, and why - for what is off, how to switch it on."""

    state: Literal["on", "idle", "off", "warn"]
    stage: str
    why: str

    def __str__(self) -> str:
        return f" {self.state:5s} {self.stage:22s} {self.why}"


@dataclass(frozen=True)
class Recomputation:
    """What a gradient with `Checkpoints` takes: the most bytes of states at a time, the steps that the run and the way
    back take together, and how often the step that is taken most is taken."""

    bytes: int
    advances: int
    most: int

    def __str__(self) -> str:
        return f"{self.bytes} bytes of states, {self.advances} steps taken, none more than {self.most} times"


@dataclass(frozen=True, eq=False)
class Plan:
    """What a run will evaluate.  `print(plan)` shows it; `predicted` is exact for explicit steppers."""

    system: Ode
    stepper: Stepper
    y0: Array
    h: float
    want: tuple[str, ...] = ()
    whole: System | None = None  # with the effects that were forbidden

    @property
    def rows(self) -> bool:
        """Whether forces are evaluated in place, on coordinate rows."""
        return applies(self.stepper, self.system)

    @property
    def implicit(self) -> bool:
        return bool(getattr(self.stepper, "implicit", False))

    @cached_property
    def predicted(self) -> Counters:
        """Counts of one step: exact for explicit steppers, the least possible for implicit ones."""
        system = self.system.at(0.0, self.y0, self.h)
        start = self.stepper.start(system, 0.0, self.y0, self.h)
        if not self.implicit:
            return self.stepper.step(system, 0.0, start.y1, self.h).counters
        if not getattr(self.system, "effects", True):
            return Counters(forces=1)  # the guess, a free flight, is the answer
        return Counters(forces=2, jacobians=1, factorizations=1, solves=1, newton_iterations=1)

    @cached_property
    def lines(self) -> tuple[Line, ...]:
        return tuple([*self._effects(), *self._stages(), *self._warnings()])

    @property
    def warnings(self) -> tuple[Line, ...]:
        return tuple(line for line in self.lines if line.state == "warn")

    def _effects(self) -> Iterator[Line]:
        if not isinstance(self.system, System):
            yield Line("on", "flow", f"{self.predicted.forces} evaluations a step")
            return
        each = "at least " if self.implicit else ""
        on_rows = self.rows or body_run.applies(self.stepper, self.system)
        for effect in self.system.effects:
            where = "in place" if on_rows and has_rows(effect) else "by its force"
            yield Line("on", effect.name, f"{each}{self.predicted.forces} calls a step, {where}")
            if getattr(effect, "differenced", False):
                yield Line("on", f"{effect.name} differences", "no Jacobian was given: 9 to 10 digits, extra calls")
        for effect in self._forbidden():
            yield Line("off", effect.name, "forbidden (take it out of forbid to have it)")

    def _forbidden(self) -> tuple[Any, ...]:
        """The effects that were left out on demand."""
        kept = {effect.name for effect in getattr(self.system, "effects", ())}
        return tuple(e for e in self.whole.effects if e.name not in kept) if self.whole else ()

    def _stages(self) -> Iterator[Line]:
        needs = self.implicit
        yield Line("on" if needs else "off", "Jacobians, factorization", self._linear_algebra())
        if "gradient" in self.want:
            yield Line("on", "tape", self._tape())
        else:
            yield Line("off", "tape", "no gradient asked for (want=('gradient',))")
        if isinstance(self.system, System):
            pins = len(self.system.fixed)
            yield Line(
                "on" if pins else "off",
                "pins",
                f"{pins} point{'s' * (pins > 1)}" if pins else "no point is fixed (fixed=...)",
            )
            yield Line("off", "contact, friction", "the system has no colliders")
            if not self.system.curved:
                yield Line("off", "gyroscopic torque", "points have no inertia")
            elif not getattr(self.system, "torque", True):
                yield Line("off", "gyroscopic torque", "taken out (without)")
            elif not any(effect.name == "gyroscopic" for effect in self.system.effects):
                yield Line("off", "gyroscopic torque", "isotropic inertia: omega x I omega = 0")

    def _linear_algebra(self) -> str:
        if not self.implicit:
            return "explicit stepper (choose an implicit one)"
        size = self.system.n
        if self.band is not None:
            return f"once an iteration; band Cholesky, {size} x {self.band.width}"
        kind = "dense" if size <= DENSE_SIZE else "sparse"
        return f"once an iteration; {kind} LU, {size} x {size}"

    @cached_property
    def band(self) -> Band | None:
        """The band of an implicit step's matrix, where it is symmetric and has one."""
        if not (self.implicit and isinstance(self.system, System)) or self.system.n <= DENSE_SIZE:
            return None
        if getattr(self.stepper, "globalize", "") == "energy" and self.system.conservative:
            return None  # descent directions come from a matrix made definite
        system, weights = self.system.at(0.0, self.y0, self.h), (self.h**2, self.h)
        system.stage_matrix(0.0, system.blocks(self.y0), weights)
        return system.stage_band(weights)

    def _tape(self) -> str:
        if self.rows:
            return "the states; keep='steps' also saves what the way back needs"
        if self.band is None:
            return "the states"
        size = 8 * self.band.numbers
        return f"the states; keep='factors': {size / 1e6:.3g} MB a step, up to {FACTOR_BYTES // size} steps"

    def recomputation(self, steps: int, checkpoints: Checkpoints) -> Recomputation:
        """What the gradient of a run of so many steps will take, exactly; a pullback evaluates its step besides."""
        state = 8 * self.stepper.history * self.system.size
        kept = checkpoints.stored(steps) + 2  # the last state and the one before it are at hand
        return Recomputation(kept * state, checkpoints.advances(steps), checkpoints.most(steps))

    def _warnings(self) -> Iterator[Line]:
        for effect in getattr(self.system, "effects", ()):
            inner = getattr(effect, "effect", effect)  # of points on bodies
            stale = [c for c in DERIVATIVES if getattr(inner, c, None) and not current(inner, c, ("force",))]
            if stale:
                told = f"{type(inner).__name__} states its own force and inherits {', '.join(stale)}: check them"
                yield Line("warn", effect.name, told)
        for effect in self._forbidden():
            if self.whole is not None and (why := _acts(effect, self.whole, self.y0)):
                yield Line("warn", f"no {effect.name}", why)
        limit = getattr(self.stepper, "frequency_limit", np.inf)
        if not isinstance(self.system, System) or not np.isfinite(limit):
            return
        w = highest_frequency(self.system, self.y0)
        if self.h * w > limit:
            remedy = f"use an implicit stepper, or h < {limit / w:.2g}" if limit else "use SymplecticEuler, or damp"
            yield Line("warn", f"h w_max = {self.h * w:.3g} > {limit:.3g}", remedy)
        d = highest_damping(self.system, self.y0)
        if self.h * d > 2:
            yield Line("warn", f"h d_max = {self.h * d:.3g} > 2", f"damping blows up: implicit, or h < {2 / d:.2g}")

    def __str__(self) -> str:
        head = f"plan: {self._size()}, {type(self.stepper).__name__}, h = {self.h:.4g} s"
        return "\n".join([head, *(str(line) for line in self.lines)])

    def _size(self) -> str:
        system: Any = self.system
        if not isinstance(system, System):
            return f"{system.n} unknown{'s' * (system.n != 1)}"
        frame: Any = getattr(system, "frame", None)
        bodies = frame.bodies if frame else 0
        points = len(system.mass) - bodies
        parts = [f"{bodies} bod{'ies' if bodies > 1 else 'y'}"] if bodies else []
        parts += [f"{points} point{'s' * (points > 1)}"] if points else []
        return " and ".join(parts)

    def compared(self, counters: Counters, steps: int) -> str:
        """Predicted and actual counts of a run side by side."""
        sign = ">=" if self.implicit else "=="
        rows = [f"{'a step':18s} {'predicted':>12s} {'actual':>10s}"]
        for name in ("forces", "jacobians", "factorizations", "newton_iterations"):
            predicted, actual = getattr(self.predicted, name), getattr(counters, name) / max(steps, 1)
            rows.append(f"{name:18s} {sign + ' ' + str(predicted):>12s} {actual:10.3g}")
        return "\n".join(rows)


def plan(
    system: Ode, stepper: Stepper, y0: Any, h: float, want: tuple[str, ...] = (), forbid: tuple[str, ...] = ()
) -> Plan:
    """What `simulate` would evaluate, and why the rest stays off.  want: ("gradient",) where one is asked for.

    forbid: names of effects to leave out, with a warning where they act; `.system` is what is left to simulate.

    Raises ValueError on bad input.

    >>> from dsim.effects import Gravity
    >>> from dsim.steppers import SymplecticEuler
    >>> print(plan(System([1.0], Gravity([0.0, -9.8]), 2), SymplecticEuler(), [0, 0, 1, 1], h=0.1))
    plan: 1 point, SymplecticEuler, h = 0.1 s
     on    gravity                1 calls a step, in place
     off   Jacobians, factorization explicit stepper (choose an implicit one)
     off   tape                   no gradient asked for (want=('gradient',))
     off   pins                   no point is fixed (fixed=...)
     off   contact, friction      the system has no colliders
     off   gyroscopic torque      points have no inertia
    """
    for item in want:
        if item not in WANTS:
            raise ValueError(f"want must name some of {', '.join(WANTS)}; got {item!r}")
    y0, h = as_array("y0", y0, (system.size,)), as_step(h)
    if not forbid:
        return Plan(system, stepper, y0, h, tuple(want))
    if not isinstance(system, System):
        raise ValueError("forbid needs a System of masses with effects; a Flow has none")
    return Plan(system.without(*forbid), stepper, y0, h, tuple(want), system)


def _acts(effect: Any, system: System, y0: Array) -> str:
    """What a forbidden effect would do: push at the start, or with any change of the state; "" for neither."""
    place = system.blocks(y0)
    force = float(np.abs(system.free * effect.force(0.0, *place)).max(initial=0.0))
    if force > 0:
        return f"it pushes with up to {force:.3g} N at the start"
    for capability, what in (("dq", "position"), ("dv", "velocity")):
        if getattr(effect, capability, None) is not None and abs(getattr(effect, capability)(0.0, *place)).sum() > 0:
            return f"it pushes as soon as a {what} changes"
    return ""


def highest_frequency(system: System, y0: Array) -> float:
    """w_max, rad/s: the root of the largest eigenvalue of -M^-1 K at y0 (symmetric part), pinned points left out."""
    if not system.having("dq"):
        return 0.0
    return float(np.sqrt(max(0.0, _largest(system, -system.dq(0.0, *system.blocks(y0))))))


def highest_damping(system: System, y0: Array) -> float:
    """d_max, 1/s: the largest eigenvalue of -M^-1 D at y0 (symmetric part)."""
    if not system.having("dv"):
        return 0.0
    return max(0.0, _largest(system, -system.dv(0.0, *system.blocks(y0))))


def _largest(system: System, matrix: Any) -> float:
    """The largest eigenvalue of M^-1/2 (A + A^T)/2 M^-1/2 on the free degrees of freedom."""
    from scipy.sparse import csr_array, diags_array

    scale = csr_array(diags_array(system.free) @ system.inverse_root())
    symmetric = csr_array(scale.T @ (matrix + matrix.T) @ scale) * 0.5
    if not symmetric.data.any():
        return 0.0
    if system.n <= DENSE_SIZE:
        return float(np.linalg.eigvalsh(symmetric.toarray())[-1])
    from scipy.sparse.linalg import eigsh

    start = np.random.default_rng(0).normal(size=system.n)
    return float(eigsh(symmetric, k=1, which="LA", v0=start, tol=1e-4, return_eigenvectors=False)[0])
