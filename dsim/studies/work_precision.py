"""What accuracy costs: errors of states and gradients over seconds and counts, for any method on any problem.

    study = work_precision(projectile(), [RK4(), MyStepper()])
    study.cheapest(1e-6)

A cell is one run: a problem, a method, and a step size or tolerance.  Its errors and counts are exact and repeatable;
its seconds are measured in chunks, interleaved with the other methods, beside a control that shows the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.gradients.adjoint import adjoint
from dsim.simulation import record, simulate
from dsim.solve.newton import Status
from dsim.steppers import RK4
from dsim.steppers.stepper import Stepper
from dsim.studies.cells import Store
from dsim.studies.convergence import OrderFit, fit_order
from dsim.studies.problems import Problem, adjoint_run
from dsim.studies.reference import Reference
from dsim.studies.stopwatch import time_interleaved

BLOWN_UP = 100.0  # a scaled error beyond this is no solution
TARGETS = tuple(10.0**-k for k in range(2, 9))
FINEST = {"Radau": 8}  # of order 5 and implicit: 1e-8 already takes a thousand steps
CLIP = 100.0  # certificates: below this many nothing is plotted, so the truth is known to a hundredth of each error
QUANTITIES = ("state", "gradient")

Method = Stepper | Reference


@dataclass(frozen=True)
class Cell:
    """One run.  setting: h in s, or a tolerance.  error, gradient_error: scaled; inf where the run failed.

    seconds, gradient_seconds: least of the repeats (forward; forward and adjoint), nan when not timed.  A study
    replaces them by the median ratio to the control times the control's least seconds: see `steadied`.
    drift: largest relative change of an invariant.  counts: of the run; gradient runs linearize on top of it.
    """

    problem: str
    method: str
    setting: float
    steps: int
    status: str
    error: float
    gradient_error: float
    drift: float
    counts: dict[str, int]
    seconds: float = float("nan")
    gradient_seconds: float = float("nan")
    timing: dict[str, dict[str, float]] | None = None
    band: tuple[float, float] = (1.0, 1.0)  # the A/A control beside it: ratios of a run to itself

    @property
    def failed(self) -> bool:
        return self.status != Status.CONVERGED

    def error_of(self, quantity: str) -> float:
        return self.error if quantity == "state" else self.gradient_error

    def cost(self, quantity: str, unit: str = "seconds") -> float:
        """Seconds, or force evaluations of the run."""
        if unit != "seconds":
            return float(self.counts["forces"])
        return self.seconds if quantity == "state" else self.gradient_seconds


@dataclass(frozen=True)
class Answer:
    """The cheapest method for an error, its cost, and the methods that the noise cannot tell from it."""

    target: float
    method: str
    cost: float
    ties: tuple[str, ...] = ()

    @property
    def reached(self) -> bool:
        return bool(self.method)

    def __str__(self) -> str:
        if not self.reached:
            return "not reached"
        return self.method + (f" (= {', '.join(self.ties)})" if self.ties else "")


@dataclass(frozen=True, eq=False)
class Study:
    """All cells of a problem.  unit: "seconds", or "forces" when nothing was timed."""

    problem: str
    cells: tuple[Cell, ...]
    certificate: float
    gradient_certificate: float
    unit: str = "seconds"

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(cell.method for cell in self.cells))

    @property
    def band(self) -> tuple[float, float]:
        """The A/A control's widest ratios: what lies within is noise."""
        return min(c.band[0] for c in self.cells), max(c.band[1] for c in self.cells)

    def floor(self, quantity: str = "state") -> float:
        """Errors below a hundred certificates are clipped here."""
        return CLIP * (self.certificate if quantity == "state" else self.gradient_certificate)

    def of(self, method: str) -> tuple[Cell, ...]:
        """The cells of a method, coarsest first."""
        return tuple(sorted((c for c in self.cells if c.method == method), key=lambda c: -c.setting))

    def points(self, method: str, quantity: str = "state") -> tuple[Array, Array]:
        """(cost, error) of the runs that ended well; an error below the floor is only known to be no larger than it."""
        good = [c for c in self.of(method) if not c.failed]
        error = [max(c.error_of(quantity), self.floor(quantity)) for c in good]
        return np.array([c.cost(quantity, self.unit) for c in good]), np.array(error)

    def order(self, method: str, quantity: str = "state") -> OrderFit | None:
        """The slope on the asymptotic window; None with fewer than three points, or for a tolerance."""
        good = [c for c in self.of(method) if c.steps and not c.failed and c.error_of(quantity) >= self.floor(quantity)]
        return asymptotic_order([c.setting for c in good], [c.error_of(quantity) for c in good])

    def front(self, quantity: str = "state") -> tuple[Cell, ...]:
        """The Pareto set: no other run is both cheaper and more accurate."""
        good = [c for c in self.cells if not c.failed]
        costs = [c.cost(quantity, self.unit) for c in good]
        errors = [max(c.error_of(quantity), self.floor(quantity)) for c in good]
        return tuple(good[i] for i in pareto(costs, errors))

    def cheapest(self, target: float, quantity: str = "state") -> Answer:
        """The method that reaches `target` at the least cost, interpolated in log-log and never extrapolated."""
        costs = {m: cost_at(*self.points(m, quantity), target) for m in self.methods}
        reached = sorted((cost, m) for m, cost in costs.items() if cost is not None)
        if not reached:
            return Answer(target, "", float("nan"))
        least, best = reached[0]
        ties = tuple(m for cost, m in reached[1:] if cost <= least * (self.band[1] if self.unit == "seconds" else 1.0))
        return Answer(target, best, least, ties)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON's kinds; numbers that are not finite become null."""
        answers = {q: {f"{t:.0e}": asdict(self.cheapest(t, q)) for t in TARGETS} for q in QUANTITIES}
        fits = {m: self.order(m) for m in self.methods}
        orders = {m: [f.order, f.standard_error, f.r_squared, len(f.h)] for m, f in fits.items() if f}
        cells = [asdict(c) for c in self.cells]
        front = {q: [[c.method, c.setting] for c in self.front(q)] for q in QUANTITIES}
        return finite(
            {
                "problem": self.problem, "unit": self.unit, "band": self.band, "certificate": self.certificate,
                "gradient_certificate": self.gradient_certificate, "orders": orders, "cheapest": answers,
                "pareto": front, "cells": cells,
            }
        )  # fmt: skip


def finite(value: Any) -> Any:
    """The value with None for what JSON cannot say: inf and nan."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


# Analysis


def asymptotic_order(h: Sequence[float], error: Sequence[float]) -> OrderFit | None:
    """`fit_order` on the finest six points of the longest window in which the error falls with h; None if < 3."""
    places = np.argsort(h)[::-1]
    x, y = np.asarray(h, dtype=float)[places], np.asarray(error, dtype=float)[places]
    cuts = [0, *(np.flatnonzero(~(y[1:] < y[:-1])) + 1), len(y)]
    start, stop = max(pairwise(cuts), key=lambda w: (w[1] - w[0], w[0]), default=(0, 0))
    start = max(start, stop - 6)
    return fit_order(x[start:stop], y[start:stop]) if stop - start >= 3 else None


def pareto(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """Indices of the points that no other one beats in both, cheapest first.

    >>> pareto([1.0, 2.0, 3.0, 4.0], [1e-1, 1e-3, 1e-2, 1e-4])
    [0, 1, 3]
    """
    front: list[int] = []
    for i in sorted(range(len(cost)), key=lambda i: (cost[i], error[i])):
        if not front or error[i] < error[front[-1]]:
            front.append(i)
    return front


def cost_at(cost: Array, error: Array, target: float) -> float | None:
    """The least cost of an error <= target: a measured run, or a point between two neighbours of the sweep.

    None where no run of the sweep is accurate enough.

    >>> round(cost_at(np.array([1.0, 10.0]), np.array([1e-2, 1e-4]), 1e-3), 4)
    3.1623
    >>> cost_at(np.array([1.0, 10.0]), np.array([1e-2, 1e-4]), 1e-5) is None
    True
    """
    found = [float(c) for c, e in zip(cost, error, strict=True) if e <= target * (1 + 1e-12)]
    for i in range(len(cost) - 1):
        coarse, fine = error[i], error[i + 1]
        if fine < target < coarse:
            share = np.log(coarse / target) / np.log(coarse / fine)
            found.append(float(np.exp((1 - share) * np.log(cost[i]) + share * np.log(cost[i + 1]))))
    return min(found, default=None)


# Measurement


def name_of(method: Method) -> str:
    """ "RK4", "DOP853", or a stepper's own `label`, where two of a kind compete."""
    return method.method if isinstance(method, Reference) else getattr(method, "label", type(method).__name__)


@dataclass(frozen=True)
class Sweep:
    """How finely and how often to measure.  levels: step sizes, each half of the one before; implicit steppers, whose
    steps cost ten times as much, take `costly` of them."""

    levels: int = 7
    costly: int = 6
    rounds: int = 2  # ABBA rounds; 0: nothing is timed, and counts are the cost

    def settings(self, problem: Problem, method: Method) -> tuple[float, ...]:
        """Step counts, or tolerances."""
        if isinstance(method, Reference):
            exponents = np.linspace(3, FINEST.get(method.method, 12), self.levels).round()
            return tuple(dict.fromkeys(float(f"1e-{k:.0f}") for k in exponents))
        levels = self.costly if getattr(method, "implicit", False) else self.levels
        return tuple(problem.coarsest * 2**k for k in range(levels))


QUICK = Sweep(levels=3, costly=2, rounds=1)
COUNTED = Sweep(levels=5, costly=3, rounds=0)


def work_precision(
    problem: Problem,
    methods: Iterable[Method],
    sweep: Sweep | None = None,
    store: Store | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Study:
    """Put methods - dsim's, SciPy's or your own - on one error-cost plane.

    Every cell is kept in `store` as soon as it is finished, and is not measured again.  A method that fails is a cell
    with an infinite error.  Raises ValueError if two methods share a name.
    """
    methods, sweep, store = tuple(methods), sweep or Sweep(), store or Store()
    names = [name_of(m) for m in methods]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"methods must have different names; got two called {name!r} (give one a `label`)")
    cells: list[Cell] = []
    for level in range(max(sweep.levels, sweep.costly)):
        missing: dict[str, tuple[Method, float]] = {}
        for method in methods:
            settings = sweep.settings(problem, method)
            if level < len(settings):
                kept = store.get(*_key(problem, method, settings[level], sweep))
                if kept is None:
                    missing[name_of(method)] = (method, settings[level])
                else:
                    cells.append(_from_dict(kept))
        cells += _measure_level(problem, missing, sweep, store, progress)
    ranked = sorted(cells, key=lambda c: names.index(c.method))
    unit = "seconds" if sweep.rounds else "forces"
    return Study(problem.name, steadied(ranked), *_certificates(problem, store), unit)


def steadied(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    """Seconds = median paired ratio to the control x the control's least seconds in the study.

    Levels are timed minutes apart, in which a shared machine changes its speed; the ratio to a control measured in the
    same breath does not.
    """
    timings = [timing for cell in cells if cell.timing for timing in cell.timing.values()]
    base = min((timing["control"] for timing in timings), default=1.0)

    def steady(cell: Cell) -> Cell:
        if not cell.timing:
            return cell
        state, gradient = (base * cell.timing[quantity]["ratio"] for quantity in QUANTITIES)
        return replace(cell, seconds=state, gradient_seconds=gradient)

    return tuple(steady(cell) for cell in cells)


def _certificates(problem: Problem, store: Store) -> tuple[float, float]:
    """How well states and gradient are known; kept too, since two integrators at 1e-12 take their time."""
    key = ("certificates", *_identity(problem))
    kept = store.get(*key)
    if kept is None:
        kept = {"values": [problem.certificate, problem.gradient_certificate]}
        store.put(kept, *key)
    state, gradient = kept["values"]
    return state, gradient


def _measure_level(
    problem: Problem, missing: dict[str, tuple[Method, float]], sweep: Sweep, store: Store, progress: Any
) -> list[Cell]:
    """Untimed errors and counts first, method by method; then all of the level interleaved."""
    cells: dict[str, Cell] = {}
    for name, (method, setting) in missing.items():
        progress(f"{problem.name}, {name}, {_words(method, setting)}")
        cells[name] = measure(problem, method, setting)
        if not sweep.rounds or cells[name].failed:
            store.put(asdict(cells[name]), *_key(problem, method, setting, sweep))
    alive = {name: missing[name] for name, cell in cells.items() if not cell.failed}
    if sweep.rounds and alive:
        progress(f"{problem.name}, timing {len(alive)} methods")
        for name, cell in _timed(problem, alive, cells, sweep.rounds).items():
            cells[name] = cell
            store.put(asdict(cell), *_key(problem, *alive[name], sweep))
    return list(cells.values())


def _key(problem: Problem, method: Method, setting: float, sweep: Sweep) -> tuple[str, ...]:
    label = f"{name_of(method)} {method!r}" if hasattr(method, "__dataclass_fields__") else name_of(method)
    kind = "timed" if sweep.rounds else "counted"
    return *_identity(problem), label, _formula(method), repr(setting), kind


def _formula(method: Method) -> str:
    """The rule's code: a formula that was changed is another method."""
    return _words_of_code(getattr(getattr(type(method), "rule", None), "__code__", None))


def _words_of_code(code: Any) -> str:
    if code is None:
        return ""
    inner = [_words_of_code(c) if hasattr(c, "co_code") else repr(c) for c in code.co_consts]
    return repr((code.co_code, code.co_names, inner))


def _identity(problem: Problem) -> tuple[str, ...]:
    """Numbers, and what functions give: the flow at the start and a little off, the closed form at the end."""
    y0, system = problem.y0, problem.system
    with np.errstate(all="ignore"):
        pushed = [system.flow(t, y).tolist() for t, y in ((0.0, y0), (0.1, 1.01 * y0 + 0.01))]
    end = None if problem.exact is None else np.asarray(problem.exact(problem.duration)).tolist()
    parts = (problem.duration, y0.tolist(), system.theta.tolist(), problem.scale.tolist(), pushed, end)
    return problem.name, repr(parts)


def _words(method: Method, setting: float) -> str:
    return f"tolerance {setting:.0e}" if isinstance(method, Reference) else f"{setting:.0f} steps"


def _from_dict(kept: dict[str, Any]) -> Cell:
    return Cell(**{**kept, "band": tuple(kept["band"])})


def measure(problem: Problem, method: Method, setting: float) -> Cell:
    """Errors and counts of one run, without a clock.  setting: number of steps, or tolerance."""
    if isinstance(method, Reference):
        return _measure_reference(problem, replace(method, rtol=setting))
    steps = int(setting)
    run = record(method, problem.system, problem.y0, problem.duration / steps, steps, keep="steps")
    status, error, slope_error, drift = str(run.status), np.inf, np.inf, np.inf
    if run.status is Status.CONVERGED:
        error = problem.state_error(run.t, run.y)
        status = status if error <= BLOWN_UP else "blow-up"
    if status == Status.CONVERGED:
        gradient = adjoint(run, _final(problem, run.y)).y0
        slope_error = problem.gradient_error(gradient, problem.truth().gradient)
        drift = max(problem.drift(run.t, run.y).values(), default=float("nan"))
    error = error if status == Status.CONVERGED else np.inf
    counts = asdict(run.counters) | {"tape_bytes": run.tape_bytes}
    return Cell(problem.name, name_of(method), run.h, steps, status, error, slope_error, drift, counts)


def _measure_reference(problem: Problem, method: Reference) -> Cell:
    """A SciPy integrator at its own steps; its gradient by the adjoint equation at the same tolerance."""
    found = _solve(problem, method)
    t, y = found.t, found.y.T
    counts = {"forces": int(found.nfev), "jacobians": int(found.njev), "factorizations": int(found.nlu)}
    try:
        gradient, _ = adjoint_run(problem, method, y[-1]) if found.success else (y[-1], None)
        status = str(Status.CONVERGED) if found.success else "gave up"
    except ArithmeticError:
        status = "gave up"
    if status != Status.CONVERGED:
        nothing = (np.inf, np.inf, np.inf)
        return Cell(problem.name, method.method, method.rtol, 0, status, *nothing, counts)
    truth = problem.truth(method.method)
    return Cell(
        problem.name, method.method, method.rtol, 0, str(Status.CONVERGED),
        problem.state_error(t, y, method.method), problem.gradient_error(gradient, truth.gradient),
        max(problem.drift(t, y).values(), default=float("nan")),
        counts,
    )  # fmt: skip


def _solve(problem: Problem, method: Reference) -> Any:
    from scipy.integrate import solve_ivp

    # SciPy takes few, long steps: a bound keeps at least as many grid times as the errors are sampled at
    atol = method.rtol * max(1.0, float(np.abs(problem.y0).max()))
    span, longest = (0.0, problem.duration), problem.duration / 24
    return solve_ivp(
        problem.system.flow, span, problem.y0, method.method, rtol=method.rtol, atol=atol, max_step=longest
    )


def _final(problem: Problem, y: Array) -> Array:
    slope = np.zeros_like(y)
    slope[-1] = problem.slope(y[-1])
    return slope


def _timed(
    problem: Problem, alive: dict[str, tuple[Method, float]], cells: dict[str, Cell], rounds: int
) -> dict[str, Cell]:
    forward = {name: _runner(problem, method, setting, False) for name, (method, setting) in alive.items()}
    both = {name: _runner(problem, method, setting, True) for name, (method, setting) in alive.items()}
    h, steps = problem.duration / problem.coarsest, problem.coarsest

    def control() -> Any:  # recorded: a blow-up is no reason to lose the control
        return record(RK4(), problem.system, problem.y0, h, steps)

    plain, band = time_interleaved(forward, control, rounds)
    whole, second = time_interleaved(both, control, rounds)
    band = min(band[0], second[0]), max(band[1], second[1])
    return {
        name: replace(
            cells[name],
            seconds=plain[name].least,
            gradient_seconds=whole[name].least,
            timing={"state": asdict(plain[name]), "gradient": asdict(whole[name])},
            band=band,
        )
        for name in alive
    }


def _runner(problem: Problem, method: Method, setting: float, gradient: bool) -> Callable[[], Any]:
    """What is timed: the run alone, or the run and the gradient of its objective."""
    if isinstance(method, Reference):
        reference = replace(method, rtol=setting)
        if not gradient:
            return lambda: _solve(problem, reference)
        return lambda: adjoint_run(problem, reference, _solve(problem, reference).y[:, -1])
    steps = int(setting)
    h = problem.duration / steps

    def run() -> Any:
        trajectory = simulate(method, problem.system, problem.y0, h, steps, keep="steps" if gradient else "states")
        return adjoint(trajectory, _final(problem, trajectory.y)) if gradient else trajectory

    return run
