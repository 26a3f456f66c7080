"""A whole explicit run, and its adjoint, on coordinate rows.

The same rule and the same coefficients as the plain path, evaluated on arrays (d,N) with the effects' in-place
forces; no Step objects, no patterns, no matrices.  Tests hold states and gradients against the plain path.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects.rows import Rows, rows_of
from dsim.steppers.rule import RuleStepper, tableau_of
from dsim.steppers.tableau import Symbol, Tableau, combine
from dsim.system import System

TAPE_BYTES = 2**30  # above this, the way back evaluates the edges again instead of keeping them

Saved = list[tuple[Array, ...]]  # a row of arrays an effect
_CHECKED = 64  # steps between looks for a number that is not finite


def applies(stepper: Any, system: Any) -> bool:
    """Whether the run is one of `ExplicitRun`: an explicit one-step rule on a System without discrete choices."""
    plain = type(stepper).step is RuleStepper.step and type(stepper).linearize is RuleStepper.linearize
    explicit = plain and not stepper.implicit and stepper.history == 1
    return explicit and isinstance(system, System) and not any(hasattr(e, "at") for e in system.effects)


@dataclass(eq=False)
class ExplicitRun:
    """Forces bound to rows.  `evaluate` fills states; `pull` carries a gradient back over them."""

    stepper: Any  # an explicit one-step RuleStepper
    system: Any  # a System; see `applies`
    h: float
    tape: list[list[tuple[Array, Saved]]] | None = None  # a step -> a stage -> its rate and what the effects saved
    stages: int = field(init=False, default=0)  # rates a step
    states: Array = field(init=False, repr=False)  # (N+1,2,d,N), the velocity of pinned points 0
    y0: Array = field(init=False, repr=False)  # as it was given
    evaluations: int = field(init=False, default=0)  # of the rate
    _rows: list[Rows] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        system = self.system
        self.shape = (system.dimension, len(system.mass))
        self._rows = [rows_of(effect) for effect in system.effects]
        self._scale = (system.free / system.masses).reshape(self.shape[::-1]).T.copy()  # M^-1, 0 at pins
        self._scratch = self._fresh()

    @property
    def tableau(self) -> Tableau:
        return tableau_of(self.stepper.rule, self.stepper.form, 2, self.h)

    def tape_bytes(self, steps: int) -> int:
        """Size of the tape of so many steps."""
        numbers = sum(int(np.prod(shape)) for rows in self._rows for shape in rows.saves)
        return 8 * steps * len(self.tableau.stages) * (numbers + self.shape[0] * self.shape[1])

    def _fresh(self) -> Saved:
        return [tuple(np.empty(shape) for shape in rows.saves) for rows in self._rows]

    def rate(self, t: float, x: Array, v: Array, saved: Saved) -> Array:
        """M^-1 f on rows."""
        self.evaluations += 1
        force = np.zeros(self.shape)
        for rows, kept in zip(self._rows, saved, strict=True):
            rows.add_force(t, x, v, force, kept)
        force *= self._scale
        return force

    def evaluate(self, y0: Array, steps: int, keep_tape: bool) -> int:
        """Take up to `steps` steps; the number of those that stayed finite."""
        self.tape = [] if keep_tape and self.tape_bytes(steps) <= TAPE_BYTES else None
        self.y0 = y0
        self.states = np.empty((steps + 1, 2, *self.shape))
        self.states[0] = y0.reshape(2, *self.shape[::-1]).transpose(0, 2, 1)
        self.states[0, 1] *= self._scale != 0  # pinned points have no velocity
        n, done = 0, True
        while n < steps and done:
            self._advance(n * self.h, self.states[n], self.states[n + 1])
            n += 1
            if n == 1:
                self.stages = self.evaluations
            done = n % _CHECKED != 0 or bool(np.isfinite(self.states[n]).all())
        finite: Any = np.isfinite(self.states[1 : n + 1]).all(axis=(1, 2, 3))
        good = n if finite.all() else int(finite.argmin())
        self.states = self.states[: good + 1]
        return good

    def public_states(self) -> Array:
        """The states as rows y_n = [q, v], (N+1, 2n); the first one as it was given."""
        y = self.states.transpose(0, 1, 3, 2).copy().reshape(len(self.states), -1)
        y[0] = self.y0
        return y

    def _advance(self, t: float, z: Array, new: Array) -> None:
        stages: list[tuple[Array, Saved]] = []

        def rate(t: float, x: Array, v: Array) -> Array:
            saved = self._scratch if self.tape is None else self._fresh()
            k = self.rate(t, x, v, saved)
            if self.tape is not None:
                stages.append((k, saved))
            return k

        if self.stepper.form == 2:
            new[0], new[1] = self.stepper.rule({0: z[0]}, {0: z[1]}, rate, t, self.h)
        else:
            new[:] = self.stepper.rule({0: z}, lambda t, y: np.stack([y[1], rate(t, *y)]), t, self.h)
        if self.tape is not None:
            self.tape.append(stages)

    # The way back

    def pull(self, dJdy: Array) -> tuple[Array, Array]:
        """(dJ/dy0 without dJdy[0], dJ/dtheta) over all steps."""
        system, steps = self.system, len(self.states) - 1
        theta_bar = np.zeros(system.parameter_count)
        views = [[theta_bar[p.place].reshape(p.shape) for p in parameters] for parameters in system.layout]
        inertia = np.zeros(self.shape)  # k . w, summed over the steps
        loads = dJdy.reshape(steps + 1, 2, *self.shape[::-1]).transpose(0, 1, 3, 2)
        mu: Any = tuple(np.zeros((2, *self.shape)))
        for n in range(steps - 1, -1, -1):
            if dJdy[n + 1].any():
                mu = tuple(bar + load for bar, load in zip(mu, loads[n + 1], strict=True))
            mu = self._pull_step(n, self.states[n], mu, (views, inertia))
        theta_bar[: len(system.mass)] -= inertia.sum(axis=0)
        by_q, by_v = mu[0], mu[1] * (self._scale != 0)
        return np.concatenate([by_q.T.ravel(), by_v.T.ravel()]), theta_bar

    def _pull_step(self, n: int, z: Array, mu: Any, sums: tuple[Any, Array]) -> Any:
        views, inertia = sums
        tableau, t = self.tableau, n * self.h
        values: dict[Symbol, Array] = {("y", 0, 0): z[0], ("y", 0, 1): z[1]}
        places, saved = self._stages(n, values)
        bars: dict[Symbol, Array] = {}
        for part, bar in zip(tableau.outcome, mu, strict=True):
            _spread(bars, part, bar)
        for symbol in (("y", 0, 0), ("y", 0, 1)):
            bars.setdefault(symbol, np.zeros(self.shape))
        for s in range(len(tableau.stages) - 1, -1, -1):
            stage, symbol = tableau.stages[s], ("k", s, 0)
            if symbol not in bars:
                continue
            w = bars[symbol]
            w *= self._scale
            inertia += values[symbol] * w
            pulled = np.zeros((2, *self.shape))
            for rows, kept, own in zip(self._rows, saved[s], views, strict=True):
                rows.add_vjp(t + stage.offset, places[s], w, (*pulled, *own), kept)
            for part, bar in zip(stage.arguments, pulled, strict=True):
                _spread(bars, part, bar)
        return bars["y", 0, 0], bars["y", 0, 1]

    def _stages(self, n: int, values: dict[Symbol, Array]) -> tuple[list[Any], list[Saved]]:
        """Where each stage stood and what its effects saved: from the tape, or evaluated again."""
        places: list[Any] = []
        saved: list[Saved] = []
        for s, stage in enumerate(self.tableau.stages):
            x, v = (_value(part, values) for part in stage.arguments)
            if self.tape is not None:
                k, kept = self.tape[n][s]
            else:
                kept = self._fresh()
                k = self.rate(n * self.h + stage.offset, x, v, kept)
            values["k", s, 0] = k
            places.append((x, v))
            saved.append(kept)
        return places, saved


def _value(part: Any, values: dict[Symbol, Array]) -> Array:
    """`combine`, without a copy where the form is one symbol."""
    if len(part) == 1:
        ((symbol, coefficient),) = part.items()
        if coefficient == 1.0:
            return values[symbol]
    return np.asarray(combine(part, values))


def _spread(bars: dict[Symbol, Array], part: Any, bar: Array) -> None:
    """The transpose of `combine`; the arrays in `bars` are its own."""
    for symbol, coefficient in part.items():
        if symbol in bars:
            bars[symbol] += bar if coefficient == 1.0 else coefficient * bar
        else:
            bars[symbol] = coefficient * bar
