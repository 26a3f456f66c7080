"""A whole explicit run, and its adjoint, on coordinate rows.

The same rule and the same coefficients as the plain path, evaluated on arrays (d,N) with the effects' in-place
forces; no Step objects, no patterns, no matrices.  Tests hold states and gradients against the plain path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects.rows import Rows, rows_of
from dsim.steppers.rule import RuleStepper, tableau_of
from dsim.steppers.tableau import Symbol, Tableau, combine
from dsim.system import System

TAPE_BYTES = 2**30  # above this, the way back evaluates the edges again instead of keeping them

Saved = list[tuple[Array, ...]]  # a row of arrays an effect


def applies(stepper: Any, system: Any) -> bool:
    """Whether the run is one of `ExplicitRun`: an explicit one-step rule on a System without discrete choices."""
    plain = type(stepper).step is RuleStepper.step and type(stepper).linearize is RuleStepper.linearize
    explicit = plain and not stepper.implicit and stepper.history == 1
    return explicit and type(system) is System and not any(hasattr(e, "at") for e in system.effects)


class Tape:
    """What the way back needs of every stage, in a few large blocks: its rate and what the effects saved."""

    def __init__(self, steps: int, stages: int, shape: tuple[int, int], rows: list[Rows]) -> None:
        self.rates = np.empty((steps, stages, *shape))
        self._saved = [[np.empty((steps, stages, *own)) for own in effect.saves] for effect in rows]

    def at(self, n: int, stage: int) -> tuple[Array, Saved]:
        """Views: the rate (d,N) and, an effect, its arrays."""
        return self.rates[n, stage], [tuple(block[n, stage] for block in blocks) for blocks in self._saved]


@dataclass(eq=False)
class ExplicitRun:
    """Forces bound to rows.  `evaluate` fills states; `pull` carries a gradient back over them."""

    stepper: Any  # an explicit one-step RuleStepper
    system: Any  # a System; see `applies`
    h: float
    tape: Tape | None = None
    states: Array = field(init=False, repr=False)  # (N+1,2,d,N), the velocity of pinned points 0
    y0: Array = field(init=False, repr=False)  # as it was given
    evaluations: int = field(init=False, default=0)  # of the rate
    effect_rows: list[Rows] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        system = self.system
        self.shape = (system.dimension, len(system.mass))
        self.effect_rows = [rows_of(effect) for effect in system.effects]
        self._constant = np.zeros(self.shape)  # forces that are the same at any time and state, summed once
        self._forces = []  # the others, with their places in what is saved
        for place, rows in enumerate(self.effect_rows):
            if (constant := getattr(rows, "constant", None)) is not None:
                self._constant += constant
            else:
                self._forces.append((place, rows.add_force))
        self.inverse_mass = (system.free / system.masses).reshape(self.shape[::-1]).T.copy()  # M^-1, 0 at pins
        scratch = self.blank_tape(1)
        self._scratch = [scratch.at(0, s) for s in range(self.stages)]

    @cached_property
    def tableau(self) -> Tableau:
        return tableau_of(self.stepper.rule, self.stepper.form, 2, self.h)

    @cached_property
    def stages(self) -> int:
        """Rates a step, counted on zeros: a rule need not be one that `tableau` can read to be run."""
        asked: list[float] = []
        zero = np.zeros(1)

        def rate(t: float, *place: Array) -> Array:
            asked.append(t)
            return np.zeros_like(place[0])

        state = ({0: zero}, {0: zero}) if self.stepper.form == 2 else ({0: np.zeros((2, 1))},)
        self.stepper.rule(*state, rate, 0.0, self.h)
        return len(asked)

    def tape_bytes(self, steps: int) -> int:
        """Size of the tape of so many steps."""
        numbers = sum(int(np.prod(shape)) for rows in self.effect_rows for shape in rows.saves)
        return 8 * steps * self.stages * (numbers + self.shape[0] * self.shape[1])

    @property
    def nbytes(self) -> int:
        """Of states and tape."""
        return int(self.states.nbytes) + (self.tape_bytes(len(self.states) - 1) if self.tape is not None else 0)

    @cached_property
    def moves(self) -> Any:
        """False at pinned points, (d,N)."""
        return self.inverse_mass != 0

    def blank_tape(self, steps: int) -> Tape:
        """Room for what the way back needs of so many steps."""
        return Tape(steps, self.stages, self.shape, self.effect_rows)

    def rate(self, t: float, place: tuple[Array, Array], out: Array, saved: Saved) -> Array:
        """out = M^-1 f on rows."""
        self.evaluations += 1
        np.copyto(out, self._constant)
        x, v = place
        for effect, add_force in self._forces:
            add_force(t, x, v, out, saved[effect])
        out *= self.inverse_mass
        return out

    def evaluate(self, y0: Array, steps: int, keep_tape: bool) -> int:
        """Take up to `steps` steps; the number of those that stayed finite."""
        self.tape = self.blank_tape(steps) if keep_tape and self.tape_bytes(steps) <= TAPE_BYTES else None
        self.y0 = y0
        self.states = np.empty((steps + 1, 2, *self.shape))
        self.states[0] = self.inward(y0)
        flat, zeros = self.states.reshape(steps + 1, -1), np.zeros(self.states[0].size)
        good = 0
        while good < steps:
            self._advance(good, self.states[good], self.states[good + 1])
            if flat[good + 1] @ zeros != 0.0:  # 0 times what is not finite is NaN: one dot product sees them all
                break
            good += 1
        self.states = self.states[: good + 1]
        return good

    def inward(self, y: Array) -> Array:
        """A state (2n,) as coordinate rows (2,d,N), pinned points without velocity."""
        z = self.rows_of(y).copy()
        z[1] *= self.moves
        return z

    def outward(self, z: Array) -> Array:
        """Rows (2,d,N) as a state (2n,)."""
        return z.transpose(0, 2, 1).ravel()

    def step(self, n: int, z: Array) -> Array:
        """The state after step n, from the one before it, on rows; nothing is kept."""
        new = np.empty_like(z)
        with np.errstate(all="ignore"):
            self._advance(n, z, new)
        return new

    def public_states(self) -> Array:
        """The states as rows y_n = [q, v], (N+1, 2n); the first one as it was given."""
        y = self.states.transpose(0, 1, 3, 2).copy().reshape(len(self.states), -1)
        y[0] = self.y0
        return y

    def last(self) -> Array:
        """The last row of `public_states`."""
        return self.outward(self.states[-1]) if len(self.states) > 1 else self.y0

    def _advance(self, n: int, z: Array, new: Array) -> None:
        t = n * self.h
        slots = iter(self._scratch if self.tape is None else [self.tape.at(n, s) for s in range(self.stages)])

        def rate(t: float, x: Array, v: Array) -> Array:
            return self.rate(t, (x, v), *next(slots))

        if self.stepper.form == 2:
            new[0], new[1] = self.stepper.rule({0: z[0]}, {0: z[1]}, rate, t, self.h)
        else:
            new[:] = self.stepper.rule({0: z}, lambda t, y: np.stack([y[1], rate(t, *y)]), t, self.h)

    # The way back

    def pull(self, load: Callable[[int], Array | None]) -> tuple[Array, Array]:
        """(dJ/dy0 without the load of y_0, dJ/dtheta) over all steps; load: n -> dJ/dy_n on rows (2,d,N), or None."""
        back = Pullback(self)
        for n in range(len(self.states) - 2, -1, -1):
            if (bar := load(n + 1)) is not None:
                back.add(bar)
            back.step(n, self.states[n])
        return back.result()

    def rows_of(self, y: Array) -> Array:
        """States or gradients (...,2n) as coordinate rows (...,2,d,N), a view."""
        return np.swapaxes(y.reshape(*y.shape[:-1], 2, *self.shape[::-1]), -1, -2)

    def stage_values(self, n: int, values: dict[Symbol, Array], scratch: Tape | None) -> tuple[list[Any], list[Saved]]:
        """Where each stage stood and what its effects saved: from the tape, or evaluated again."""
        places: list[Any] = []
        saved: list[Saved] = []
        for s, stage in enumerate(self.tableau.stages):
            place = (_value(stage.arguments[0], values), _value(stage.arguments[1], values))
            k, kept = self.tape.at(n, s) if scratch is None else scratch.at(0, s)  # type: ignore[union-attr]
            if scratch is not None:
                self.rate(n * self.h + stage.offset, place, k, kept)
            values["k", s, 0] = k
            places.append(place)
            saved.append(kept)
        return places, saved


class Pullback:
    """A gradient on its way back over the steps of a run: dJ/dy_n on rows, and dJ/dtheta so far."""

    def __init__(self, run: ExplicitRun) -> None:
        system = run.system
        self.run = run
        self.theta_bar = np.zeros(system.parameter_count)
        self._views = [[self.theta_bar[p.place].reshape(p.shape) for p in parameters] for parameters in system.layout]
        self._inertia = np.zeros(run.shape)  # k . w, summed over the steps
        self._scratch = run.blank_tape(1) if run.tape is None else None
        self._mu: Any = tuple(np.zeros((2, *run.shape)))

    def add(self, load: Array) -> None:
        """Add dJ/dy_n (2,d,N)."""
        if load.any():
            self._mu = (self._mu[0] + load[0], self._mu[1] + load[1])

    def result(self) -> tuple[Array, Array]:
        """(dJ/dy, dJ/dtheta), the velocity of pinned points left out.  At the end, once."""
        run, theta_bar = self.run, self.theta_bar
        theta_bar[: len(run.system.mass)] -= self._inertia.sum(axis=0)
        by_q, by_v = self._mu[0], self._mu[1] * run.moves
        return np.concatenate([by_q.T.ravel(), by_v.T.ravel()]), theta_bar

    def step(self, n: int, state: Array) -> None:
        """From dJ/dy_{n+1} to dJ/dy_n; state: y_n on rows."""
        run = self.run
        tableau, t = run.tableau, n * run.h
        values: dict[Symbol, Array] = {("y", 0, 0): state[0], ("y", 0, 1): state[1]}
        places, saved = run.stage_values(n, values, self._scratch)
        bars: dict[Symbol, Array] = {}
        for part, bar in zip(tableau.outcome, self._mu, strict=True):
            _spread(bars, part, bar)
        for symbol in (("y", 0, 0), ("y", 0, 1)):
            if symbol not in bars:
                bars[symbol] = np.zeros(run.shape)
        for s in range(len(tableau.stages) - 1, -1, -1):
            stage, symbol = tableau.stages[s], ("k", s, 0)
            if symbol not in bars:
                continue
            w = bars[symbol]
            w *= run.inverse_mass
            self._inertia += values[symbol] * w
            pulled = [_target(bars, part, run.shape) for part in stage.arguments]
            for rows, kept, own in zip(run.effect_rows, saved[s], self._views, strict=True):
                rows.add_vjp(t + stage.offset, places[s], w, (*pulled, *own), kept)
            for part, bar in zip(stage.arguments, pulled, strict=True):
                if not any(bar is own for own in bars.values()):
                    _spread(bars, part, bar)
        self._mu = bars["y", 0, 0], bars["y", 0, 1]


def _target(bars: dict[Symbol, Array], part: Any, shape: tuple[int, int]) -> Array:
    """Where a stage argument's bar is summed: in the bar of its symbol, where it is one, else in zeros."""
    if len(part) == 1:
        ((symbol, coefficient),) = part.items()
        if coefficient == 1.0 and symbol in bars:
            return bars[symbol]
    return np.zeros(shape)


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
