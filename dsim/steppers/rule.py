"""From a rule, the formula of the notes, to a stepper that is solved, linearized and transposed.

A method states its rule once, with the subscripts of the notes as indices, y[0] = y_n and y[1] = y_{n+1}:

    def rule(self, y, phi, t, h):                     # a first-order method: dy/dt = phi(t, y)
        return y[0] + h * phi(t + h, y[1])

    def rule(self, q, v, a, t, h):                    # a second-order method: dv/dt = a(t, q, v)
        v1 = v[0] + h * a(t, q[0], v[0])
        return q[0] + h * v1, v1

The residual is R = y1 - rule.  Run on arrays the rule takes the step; run on symbols (`tableau`) it gives the
coefficients from which the Newton matrix, A, B, C, the tangent and the pullback follow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dsim.arrays.checks import Array, as_positive
from dsim.arrays.differences import FIRST, line_length, slope
from dsim.solve.band import BandFactor
from dsim.solve.linear import Factor, Polished, factorize
from dsim.solve.newton import Status
from dsim.steppers.charts import chart_of
from dsim.steppers.definition import curved_jacobians, jacobians
from dsim.steppers.stage import StageProblem
from dsim.steppers.stepper import Counters, Ode, Step, check_state
from dsim.steppers.tableau import Stage, Symbol, Tableau, combine, eliminate, record, self_weights

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Values = dict[Symbol, Array]


@dataclass(frozen=True)
class RuleStepper:
    """A stepper given by its rule.  Subclasses state `order`, `form` (1 or 2) and `rule`; two-step methods also
    `history = 2` and `past`, the rule for the state one step before the start."""

    order = 0
    form = 1  # the order of the differential equation the rule is written for
    history = 1
    implicit = False
    rotation = "exponential"  # how bodies are turned, see `charts`
    frequency_limit = math.inf  # an undamped oscillation grows where h w exceeds this

    def rule(self, *arguments: Any) -> Any:
        raise NotImplementedError(f"{type(self).__name__} must state its rule")

    def past(self, y: Any, phi: Any, t: float, h: float) -> Any:
        """A made-up y_{-1}: one explicit step backward, for two-step methods."""
        return y[0] - h * phi(t, y[0])

    def start(self, system: Ode, t: float, y0: Array, h: float) -> Step:
        y0 = check_state(y0, system.size, 1)
        _check_form(self, system)
        if self.history == 1:
            return Step(t, h, y0, y0, rates=())
        system = system.at(t, y0, h)
        before, rates = _explicit(self.past, 1, system, t, {0: y0}, h)
        y1 = np.concatenate([y0, before])
        return Step(t, h, y0, y1, counters=Counters(forces=len(rates)), rates=tuple(rates))

    def step(self, system: Ode, t: float, y0: Array, h: float) -> Step:
        _check_form(self, system)
        y0 = check_state(y0, system.size, self.history)
        system = self._placed(system, t, y0, h)
        if self.implicit:
            return _implicit(self, system, t, y0, h)
        y1, rates = _explicit(self.rule, self.form, system, t, _states(system, y0), h)
        status = Status.CONVERGED if np.isfinite(y1).all() else Status.NOT_FINITE
        counters = Counters(forces=len(rates))
        return Step(t, h, y0, _with_history(y1, y0, self.history), status, counters, tuple(rates))

    def _placed(self, system: Ode, t: float, y0: Array, h: float) -> Any:
        """The system of one step, in the coordinates of that step."""
        y0 = y0[: system.size]
        return chart_of(system.at(t, y0, h), y0, self.rotation)

    def residual(self, system: Ode, step: Step) -> Array:
        system = self._placed(system, step.t, step.y0, step.h)
        states = _states(system, step.y0) | {1: step.unknowns[: system.size]}
        told, _ = _explicit(self.rule, self.form, system, step.t, states, step.h)
        return step.unknowns - _with_history(told, step.y0, self.history)

    def linearize(self, system: Ode, step: Step) -> RuleLinearization:
        starting = step.y0.size < step.y1.size  # the step that `start` took
        rule, form = (self.past, 1) if starting else (self.rule, self.form)
        place = self._placed(system, step.t, step.y0, step.h)
        if system.curved:
            return CurvedLinearization(place, step, rule, form, (self, system))
        return RuleLinearization(place, step, rule, form)


@dataclass(frozen=True)
class ImplicitRuleStepper(RuleStepper):
    """A rule that asks for a rate at the new state, found by Newton.

    tol: bound on Newton's last correction of the velocity (of y, for a flow), relative to the largest velocity;
    what moves positions by less than their own round-off counts as nothing.  globalize: "none", "line_search" on the
    residual, or "energy": descent of the incremental potential where every effect has an energy, else as "line_search".
    """

    tol: float = 1e-10
    globalize: Literal["none", "line_search", "energy"] = "line_search"
    max_iterations: int = 50

    implicit = True

    def __post_init__(self) -> None:
        as_positive("tol", self.tol, ())
        if self.globalize not in ("none", "line_search", "energy"):
            raise ValueError(f'globalize must be "none", "line_search" or "energy"; got {self.globalize!r}')


@lru_cache(maxsize=256)
def _tableau(rule: Any, form: int, components: int, h: float, eliminated: bool) -> Tableau:
    tableau = record(rule, form, components, h)
    return eliminate(tableau) if eliminated else tableau


def tableau_of(rule: Any, form: int, components: int, h: float) -> Tableau:
    """The rule's stages and outcome in past states and rates alone."""
    return _tableau(rule, form, components, h, True)


def _check_form(stepper: RuleStepper, system: Ode) -> None:
    if system.curved and stepper.history > 1:
        raise ValueError(
            f"{type(stepper).__name__} looks back over two states, which rotations do not add to; "
            "use SymplecticEuler, BackwardEuler, ImplicitMidpoint, RK4 or RKMK4"
        )
    if stepper.form > system.components:
        raise ValueError(
            f"{type(stepper).__name__} needs a second-order System; got a {type(system).__name__} "
            "(use ForwardEuler, BackwardEuler, ImplicitMidpoint, Trapezoidal, BDF2 or RK4)"
        )


def _states(system: Ode, y0: Array) -> dict[int, Array]:
    """{0: y_n, -1: y_{n-1}} from a state with its history, or from columns of them."""
    return {-place: y for place, y in enumerate(y0.reshape(-1, system.size, *y0.shape[1:]))}


def _with_history(y1: Array, y0: Array, history: int) -> Array:
    return y1 if history == 1 else np.concatenate([y1, y0[: y1.size]])


def _explicit(
    rule: Any, form: int, system: Ode, t: float, states: Mapping[int, Array], h: float
) -> tuple[Array, list[Array]]:
    """The rule on arrays: the new state it tells, and the rates it asked for."""
    rates: list[Array] = []

    def rate(t: float, *place: Array) -> Array:
        rates.append(system.rate(t, *place))
        return rates[-1]

    blocks = {n: system.blocks(y) for n, y in states.items()}
    if form == 2:
        q, v = ({n: block[c] for n, block in blocks.items()} for c in (0, 1))
        return system.leave(rule(q, v, rate, t, h)), rates

    def flow(t: float, y: Array) -> Array:
        place = y.reshape(system.components, -1)
        return np.concatenate([*place[1:], rate(t, *place)])

    whole = {n: np.concatenate(block) for n, block in blocks.items()}
    return system.leave(rule(whole, flow, t, h).reshape(system.components, -1)), rates


def _values(system: Ode, states: Mapping[int, Array]) -> Values:
    return {("y", n, c): block for n, y in states.items() for c, block in enumerate(system.blocks(y))}


def _changes(system: Ode, dy0: Array) -> tuple[Any, Values]:
    """The change of the start that coordinates are about, and those of the blocks of past states."""
    if not system.curved:
        return 0.0, _values(system, _states(system, dy0))
    chart: Any = system
    start, blocks = chart.enter_tangent(dy0)
    return start, {("y", 0, c): block for c, block in enumerate(blocks)}


def _arguments(stage: Stage, values: Values, n: int) -> tuple[Array, ...]:
    return tuple(np.zeros(n) + combine(part, values) for part in stage.arguments)


def _implicit(stepper: Any, system: Ode, t: float, y0: Array, h: float) -> Step:
    """Stage after stage: evaluated where explicit, solved by Newton where it depends on its own rate."""
    tableau = _tableau(stepper.rule, stepper.form, system.components, h, True)
    values, counters = _values(system, _states(system, y0)), Counters()
    rates: list[Array] = []
    factors: dict[int, BandFactor | None] = {}
    status = Status.CONVERGED
    for number, stage in enumerate(tableau.stages):
        place, weights = _arguments(stage, values, system.n), self_weights(stage, number)
        if any(weights):
            problem = StageProblem(system, t + stage.offset, place, weights)
            result, cost = problem.solve(stepper)
            k, status, counters = result.z, result.status, counters + cost
            factors[number] = problem.factor
        else:
            k, counters = system.rate(t + stage.offset, *place), counters + Counters(forces=1)
        rates.append(k)
        values["k", number, 0] = k
        if status is not Status.CONVERGED:
            break
    y1 = system.leave([np.zeros(system.n) + combine(part, values) for part in tableau.outcome])
    if not np.isfinite(y1).all():
        status = Status.NOT_FINITE
    return Step(t, h, y0, _with_history(y1, y0, stepper.history), status, counters, tuple(rates), factors)


class RuleLinearization:
    """The linearization of one step.  `tangent`, `pullback` and its derivative eliminate the new state stage by stage
    and solve with M - c D - b K; A, B and C are the plain definition, which the tests hold against them."""

    def __init__(self, system: Ode, step: Step, rule: Any, form: int) -> None:
        self.system, self.step = system, step
        self._rule, self._form = rule, form
        self._starting = step.y0.size < step.y1.size
        self.tableau = _tableau(rule, form, system.components, step.h, True)
        self.values = _values(system, _states(system, step.y0))
        for number, k in enumerate(self._rates()):
            self.values["k", number, 0] = k
        self._factors: dict[int, Factor] = {}

    def _rates(self) -> list[Array]:
        """The stage rates: kept with the step, or evaluated again, an implicit one from y1 = ... + b k."""
        if self.step.rates is not None:
            return list(self.step.rates)
        values, rates = dict(self.values), list[Array]()
        for number, stage in enumerate(self.tableau.stages):
            symbol = ("k", number, 0)
            if any(self_weights(stage, number)):
                outcome = self.tableau.outcome[-1]
                y1 = self.system.blocks(self.step.y1[: self.system.size])[-1]
                k = (y1 - combine({s: c for s, c in outcome.items() if s != symbol}, values)) / outcome[symbol]
            else:
                k = self.system.rate(self.step.t + stage.offset, *_arguments(stage, values, self.system.n))
            values[symbol] = k
            rates.append(k)
        return rates

    def _place(self, stage: Stage) -> tuple[Array, ...]:
        return _arguments(stage, self.values, self.system.n)

    def _factor(self, number: int) -> Factor:
        """Solves with the stage matrix: factorized once for both directions, or from the factor the step kept."""
        if number not in self._factors:
            stage = self.tableau.stages[number]
            ode: Any = self.system
            weights = self_weights(stage, number)
            matrix = ode.stage_matrix(self.step.t + stage.offset, self._place(stage), weights)
            band, kept = ode.stage_band(weights), (self.step.factors or {}).get(number)
            if band is not None and kept is not None:
                self._factors[number] = Polished(matrix, band, kept)
            else:
                self._factors[number] = factorize(matrix, band)
        return self._factors[number]

    @property
    def nbytes(self) -> int:
        """Memory of the rates and of the factors made so far."""
        rates = sum(value.nbytes for symbol, value in self.values.items() if symbol[0] == "k")
        return rates + sum(factor.nbytes for factor in self._factors.values())

    def tangent(self, dy0: Array, dtheta: Array) -> Array:
        """dy1 from dy0 and dtheta, the derivative of the step in one direction, or in k: columns (...,k)."""
        return self.push(dy0, dtheta)[0]

    def push(self, dy0: Array, dtheta: Array) -> tuple[Array, Values]:
        """`tangent`, and what it went through: the changes of the state's blocks and of the rate of every stage."""
        ode: Any = self.system
        dy0 = np.asarray(dy0, dtype=float)
        start, changes = _changes(ode, dy0)
        zero = np.zeros((ode.n, *dy0.shape[1:]))
        for number, stage in enumerate(self.tableau.stages):
            time, place, k = self.step.t + stage.offset, self._place(stage), self.values["k", number, 0]
            dplace = ode.carry(place, tuple(zero + combine(part, changes) for part in stage.arguments), start)
            load = ode.stage_tangent(time, place, k, dplace, dtheta)
            implicit = any(self_weights(stage, number))
            changes["k", number, 0] = self._factor(number).solve(load) if implicit else ode.stage_solve(load)
        dparts = [zero + combine(part, changes) for part in self.tableau.outcome]
        told = ode.leave_tangent(self._outcome, dparts, start)
        return np.concatenate(self._ordered(told, dy0[: ode.size])), changes

    @property
    def _outcome(self) -> list[Array]:
        """The blocks of the new state."""
        zero = np.zeros(self.system.n)
        return [zero + combine(part, self.values) for part in self.tableau.outcome]

    def _ordered(self, told: Array, kept: Array) -> list[Array]:
        """The new state: what the rule told, then the y_n kept as history; the other way round after `start`."""
        if self.step.y1.size == self.system.size:
            return [told]
        return [kept, told] if self._starting else [told, kept]

    def pullback(self, mu: Array, theta_bar: Array) -> Array:
        """dJ/dy0 from mu = dJ/dy1: the transpose of `tangent`, stage by stage in reverse."""
        ode: Any = self.system

        def through(number: int, bar: Array) -> tuple[Array, ...]:
            stage, k = self.tableau.stages[number], self.values["k", number, 0]
            w = self._solve_transposed(number, bar)
            found: tuple[Array, ...] = ode.stage_vjp(self.step.t + stage.offset, self._place(stage), k, w, theta_bar)
            return found

        return self._back(mu, through)

    def pullback_tangent(self, mu: Array, changes: Values, dtheta: Array, theta_bars: tuple[Array, Array]) -> Array:
        """The pullback of mu[:, 0] and, beside it, its derivative along a direction in which mu changes by mu[:, 1]
        and the step by `changes`, from `push`: mu (.,2) -> (.,2), and both are added into theta_bars (P,).

        At a stage with A^T w = bar, A = M - b K - c D:  A^T dw = dbar - dM^T w + b dK^T w + c dD^T w, on the same
        factor, and d(K^T w) = dK^T w + K^T dw.
        """
        ode: Any = self.system

        def through(number: int, bar: Array) -> list[Array]:
            stage, k = self.tableau.stages[number], self.values["k", number, 0]
            time, place = self.step.t + stage.offset, self._place(stage)
            dplace = tuple(np.zeros(ode.n) + combine(part, changes) for part in stage.arguments)
            w = self._solve_transposed(number, bar[:, 0])
            pulled = ode.stage_vjp(time, place, k, w, theta_bars[0])
            change = (changes["k", number, 0], dplace, dtheta)
            inertia, turned = ode.stage_curvature(time, place, w, change, theta_bars[1])
            load = bar[:, 1] - inertia
            for weight, part in zip(self_weights(stage, number), turned, strict=True):
                load = load + weight * part
            dw = self._solve_transposed(number, load)
            again = ode.stage_vjp(time, place, k, dw, theta_bars[1])
            return [np.stack([p, c + a], axis=1) for p, c, a in zip(pulled, turned, again, strict=True)]

        return self._back(mu, through)

    def _solve_transposed(self, number: int, bar: Array) -> Array:
        """w of a stage from the bar of its rate."""
        ode: Any = self.system
        implicit = any(self_weights(self.tableau.stages[number], number))
        w: Array = self._factor(number).solve_transposed(bar) if implicit else ode.stage_solve(bar)
        return w

    def _back(self, mu: Array, through: Callable[[int, Array], Sequence[Array]]) -> Array:
        """The stages in reverse: `through` turns the bar of a rate into those of its arguments; columns (...,k) too."""
        ode: Any = self.system
        told, *kept = self._ordered(mu[: ode.size], mu[ode.size :])
        bars: Values = {}
        parts, start = ode.leave_vjp(self._outcome if ode.curved else (), told)
        for part, bar in zip(self.tableau.outcome, parts, strict=True):
            _spread(bars, part, bar)
        for number in range(len(self.tableau.stages) - 1, -1, -1):
            stage, symbol = self.tableau.stages[number], ("k", number, 0)
            if symbol not in bars:
                continue
            parts, start_bar = ode.carry_vjp(self._place(stage), through(number, bars.pop(symbol)))
            start = start + start_bar
            for part, bar in zip(stage.arguments, parts, strict=True):
                _spread(bars, {s: c for s, c in part.items() if s != symbol}, bar)
        dy0 = self._collect(bars, np.zeros((ode.n, *mu.shape[1:])), start)
        for bar in kept:
            dy0[: ode.size] += bar
        return dy0

    def _collect(self, bars: Values, zero: Array, start: Any) -> Array:
        """Bars of the state blocks -> (history * size,), nothing at the velocity of pinned points."""
        ode: Any = self.system
        count = self.step.y0.size // ode.size
        if ode.curved:
            return ode.enter_vjp(start, [bars.get(("y", 0, c), zero) for c in range(ode.components)])
        blocks = [bars.get(("y", -place, c), zero) for place in range(count) for c in range(ode.components)]
        states = np.concatenate(blocks).reshape(count, ode.size, *zero.shape[1:])
        return np.concatenate([np.concatenate(ode.blocks(state)) for state in states])

    @cached_property
    def _definition(self) -> tuple[csr_array, csr_array, csr_array]:
        step, ode = self.step, self.system
        tableau = _tableau(self._rule, self._form, ode.components, step.h, False)
        if ode.curved:
            return curved_jacobians(ode, step.t, tableau, step.y0, step.y1)
        states = _states(ode, step.y0)
        if not self._starting:
            states |= {1: step.y1[: ode.size]}
        return jacobians(ode, step.t, tableau, states, start=self._starting)

    @property
    def A(self) -> csr_array:
        """dR/dy1."""
        return self._definition[0]

    @property
    def B(self) -> csr_array:
        """dR/dy0."""
        return self._definition[1]

    @property
    def C(self) -> csr_array:
        """dR/dtheta."""
        return self._definition[2]


class CurvedLinearization(RuleLinearization):
    """Of a step of bodies.  Second derivatives are central differences of the pullback: nine to ten digits."""

    def __init__(self, system: Any, step: Step, rule: Any, form: int, again: tuple[RuleStepper, Any]) -> None:
        super().__init__(system, step, rule, form)
        self._stepper, self._whole = again

    def push(self, dy0: Array, dtheta: Array) -> tuple[Array, Values]:
        dy0 = np.asarray(dy0, dtype=float)
        if dy0.ndim > 1:
            pairs = zip(dy0.T, dtheta.T, strict=True)
            return np.stack([self.push(*pair)[0] for pair in pairs], axis=1), {}
        dy1, changes = super().push(dy0, dtheta)
        return dy1, changes | {_START: dy0}

    def pullback_tangent(self, mu: Array, changes: Values, dtheta: Array, theta_bars: tuple[Array, Array]) -> Array:
        step, dy0, own = self.step, changes[_START], np.zeros_like(dtheta)
        for place in self._whole.own.values():
            own[place] = dtheta[place]
        rest, mass = dtheta - own, self._whole.relative_change(own)
        length = line_length((step.y0, dy0), (self._whole.theta, rest), (mu[:, 0], mu[:, 1]))
        here = self.pullback(mu[:, 0], theta_bars[0])
        change = np.zeros(step.y0.size + len(dtheta))
        if length:
            change += slope(self._along(dy0, rest, mu), FIRST / length)
        if mass:  # by itself: an inertia of 1e-6 must not be stepped as if it were 1
            change += slope(self._along(0 * dy0, own, mu * [1.0, 0.0]), FIRST / mass)
        theta_bars[1][:] += change[step.y0.size :]
        return np.stack([here, change[: step.y0.size]], axis=1)

    def _along(self, dy0: Array, dtheta: Array, mu: Array) -> Callable[[float], Array]:
        """s -> (pullback, its theta_bar) at y0 + s dy0, theta + s dtheta and mu[:, 0] + s mu[:, 1]."""

        def pulled(s: float) -> Array:
            system = self._whole.with_theta(self._whole.theta + s * dtheta)
            there = self._stepper.step(system, self.step.t, self.step.y0 + s * dy0, self.step.h)
            bar = np.zeros(len(dtheta))
            return np.append(self._stepper.linearize(system, there).pullback(mu[:, 0] + s * mu[:, 1], bar), bar)

        return pulled


_START: Symbol = ("start", 0, 0)


def _spread(bars: Values, part: Mapping[Symbol, float], bar: Array) -> None:
    """The transpose of `combine`."""
    for symbol, coefficient in part.items():
        bars[symbol] = bars[symbol] + coefficient * bar if symbol in bars else coefficient * bar
