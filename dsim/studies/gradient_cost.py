"""What a gradient costs by finite differences, complex steps, sensitivities and the adjoint, over the parameters.

Lecture: "What about dynamics?" ("still very expensive if we have many DOFs, many time steps, and many parameters!").
One net, one motion, one objective; its springs are dealt out to k groups whose stiffnesses are scaled by p (k,).  So
the run costs the same for every k, and only the number of derivatives grows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim import scenes
from dsim.arrays.checks import Array, as_count
from dsim.gradients import adjoint, sensitivities
from dsim.planning import highest_frequency
from dsim.scenes import Scene
from dsim.simulation import Trajectory, simulate
from dsim.steppers import SymplecticEuler
from dsim.studies.cells import Store
from dsim.studies.check import Check
from dsim.studies.stopwatch import time_interleaved
from dsim.studies.work_precision import finite

COLUMNS = 256  # sensitivities carried along together: 16,000 unknowns and 256 columns take 33 MB
TINY = 1e-30  # the complex step: nothing is subtracted, so it may be as small as one likes
EPS = float(np.finfo(float).eps)
SLOPE_FROM = 10  # k + 1 runs are not yet proportional to k below this

Indices = NDArray[np.int64]


@dataclass
class Work:
    """Passes over the trajectory: runs, columns of sensitivities, sweeps back.  Each costs some multiple of a run."""

    runs: int = 0
    columns: int = 0
    sweeps: int = 0

    @property
    def passes(self) -> int:
        return self.runs + self.columns + self.sweeps


@dataclass(frozen=True, eq=False)
class Net:
    """A crumpled cloth of points x points, pinned at two corners, and J = |x_N - x_0|^2 / 2 of its last positions.

    steps of symplectic Euler at half the stable step.  52 x 52 points have 10,506 springs.  Spring e belongs to
    group e mod k.
    """

    points: int = 52
    steps: int = 20

    def __post_init__(self) -> None:
        as_count("points", self.points, least=2)
        as_count("steps", self.steps, least=2)  # after one, positions have not felt the springs' new stiffness yet

    @cached_property
    def scene(self) -> Scene:
        flat = scenes.cloth(n=self.points)
        system: Any = flat.system
        crumple = 0.2 / (self.points - 1) * np.random.default_rng(0).normal(size=system.n) * system.free
        y0 = flat.y0 + np.concatenate([crumple, np.zeros(system.n)])
        h = 1.0 / highest_frequency(system, y0)
        return replace(flat, y0=y0, h=h, steps=self.steps)

    @property
    def system(self) -> Any:
        return self.scene.system

    @cached_property
    def stiffness(self) -> Array:
        """(E,) N/m, of p = 1."""
        part: Array = self.system.split(self.system.theta)["springs.stiffness"]
        return part

    @cached_property
    def place(self) -> Indices:
        """Where the stiffnesses lie in theta, (E,)."""
        part: Indices = self.system.split(np.arange(self.system.parameter_count))["springs.stiffness"]
        return part

    def groups(self, k: int) -> Indices:
        """The group of every spring, (E,).  Raises ValueError for more groups than springs."""
        if not 1 <= k <= len(self.stiffness):
            raise ValueError(f"k must be from 1 to {len(self.stiffness)}, the number of springs; got {k}")
        return np.arange(len(self.stiffness)) % k

    def run(self, p: Array, keep: Any = "states") -> Trajectory:
        """The motion with the stiffnesses of p (k,)."""
        theta = self.system.theta.copy()
        theta[self.place] *= p[self.groups(len(p))]
        scene = self.scene
        return simulate(SymplecticEuler(), self.system.with_theta(theta), scene.y0, scene.h, scene.steps, keep)

    def moved(self, last: Array) -> Array:
        """x_N - x_0 as dJ/dy_N (ny,)."""
        return np.concatenate([last[: self.system.n] - self.scene.y0[: self.system.n], np.zeros(self.system.n)])

    def value(self, p: Array) -> float:
        """J."""
        moved = self.moved(self.run(p).last)
        return float(moved @ moved) / 2

    def plain(self, p: Array, kind: Any = float) -> Any:
        """J again, in one loop that is analytic in p: for complex numbers and for more digits.

        dsim's own arrays are real.  This program shares no line with it but the numbers it starts from.
        """
        from scipy.sparse import csr_array

        springs, gravity, drag = (self._effect(name) for name in ("springs", "gravity", "drag"))
        (i, j), E, N = springs.pairs.T, len(springs.pairs), len(self.system.mass)
        ends = (np.repeat([-1.0, 1.0], E), (np.tile(np.arange(E), 2), np.concatenate([i, j])))
        edges = csr_array(ends, shape=(E, N)).astype(kind)
        scatter, k = csr_array(-edges.T), springs.stiffness * np.asarray(p)[self.groups(len(p))]
        x0, v = self.scene.y0.astype(kind).reshape(2, N, -1)
        mass, free = self.system.mass[:, None], self.system.free.reshape(N, -1)
        x, h, c = x0, self.scene.h, np.broadcast_to(drag.coefficient, N)[:, None]
        for _ in range(self.steps):
            edge = edges @ x
            length = np.sqrt((edge * edge).sum(axis=1))
            force = scatter @ ((k * (1 - springs.rest_length / length))[:, None] * edge)
            v = v + h * free * ((force - c * v) / mass + gravity.acceleration)
            x = x + h * v
        return ((x - x0) ** 2).sum() / 2

    def _effect(self, name: str) -> Any:
        return next(effect for effect in self.system.effects if effect.name == name)


# The methods: (net, p (k,), the entries that are asked for, work) -> those entries of dJ/dp


def forward(net: Net, p: Array, entries: Indices, work: Work) -> Array:
    """(J(p + h e) - J(p)) / h, h = sqrt(eps): half the digits."""
    step, base = np.sqrt(EPS), _value(net, p, work)
    return np.array([(_value(net, _turned(p, i, step), work) - base) / step for i in entries])


def central(net: Net, p: Array, entries: Indices, work: Work) -> Array:
    """(J(p + h e) - J(p - h e)) / 2h, h = cbrt(eps): two thirds of them."""
    step = np.cbrt(EPS)
    sides = [[_value(net, _turned(p, i, side), work) for side in (step, -step)] for i in entries]
    return np.array([(ahead - behind) / (2 * step) for ahead, behind in sides])


def complex_step(net: Net, p: Array, entries: Indices, work: Work, kind: Any = complex) -> Array:
    """Im J(p + ih e) / h (Squire & Trapp 1998), by `Net.plain`: all digits.  kind: np.clongdouble for more."""
    found = []
    for i in entries:
        work.runs += 1
        found.append(net.plain(_turned(p.astype(kind), i, 1j * kind(TINY)), kind).imag / TINY)
    return np.array(found)


def forward_sensitivity(net: Net, p: Array, entries: Indices, work: Work) -> Array:
    """One run, then dJ/dy_N . dy_N/dp: a column a parameter."""
    work.runs += 1
    trajectory = net.run(p, keep="steps")
    slope, parts = net.moved(trajectory.last), [np.empty(0)]
    column = np.full(len(p), -1)
    for first in range(0, len(entries), COLUMNS):
        chosen = entries[first : first + COLUMNS]
        work.columns += len(chosen)
        column[:] = -1
        column[chosen] = np.arange(len(chosen))
        turned = column[net.groups(len(p))]
        springs = np.flatnonzero(turned >= 0)
        dtheta = np.zeros((net.system.parameter_count, len(chosen)))
        dtheta[net.place[springs], turned[springs]] = net.stiffness[springs]
        for change in sensitivities(trajectory, None, dtheta):
            last = change
        parts.append(slope @ last)
    return np.concatenate(parts)


def by_adjoint(net: Net, p: Array, entries: Indices, work: Work) -> Array:
    """One run, one sweep back, for all entries at once."""
    work.runs += 1
    trajectory = net.run(p, keep="steps")
    work.sweeps += 1
    gradient = adjoint(trajectory, net.moved(trajectory.last))
    whole = np.bincount(net.groups(len(p)), net.stiffness * gradient["springs.stiffness"])
    return np.asarray(whole[entries], dtype=float)


def _value(net: Net, p: Array, work: Work) -> float:
    work.runs += 1
    return net.value(p)


def _turned(p: Array, i: int, by: Any) -> Array:
    turned = p.copy()
    turned[i] += by
    return turned


Method = Callable[[Net, Array, Indices, Work], Array]

METHODS: dict[str, Method] = {
    "forward difference": forward,
    "central difference": central,
    "complex step": complex_step,
    "sensitivity": forward_sensitivity,
    "adjoint": by_adjoint,
}
GROWTH = dict.fromkeys(METHODS, 1) | {"adjoint": 0}  # the known law: passes ~ k^growth, for large k
BOUNDS = dict.fromkeys(("complex step", "sensitivity", "adjoint"), 1e-11)  # of the error, for every k


# The measurement


@dataclass(frozen=True)
class Sweep:
    """counts: the numbers of parameters, ascending.  limit, most: a method stops before it would take more seconds, or
    more passes.  rounds: ABBA rounds; 0: nothing is timed, passes are the cost.  samples: entries that are judged."""

    counts: tuple[int, ...] = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)
    limit: float = 15.0
    most: float = float("inf")
    rounds: int = 2
    samples: int = 4


@dataclass(frozen=True)
class Cell:
    """A method at k parameters.  error: largest of the sampled entries, relative to the largest of them.

    passes 0, seconds nan: over the limit, hence not run; its sampled entries were.
    """

    method: str
    parameters: int
    error: float
    passes: int = 0
    seconds: float = float("nan")
    timing: dict[str, float] | None = None
    band: tuple[float, float] = (1.0, 1.0)  # the A/A control beside it

    @property
    def ran(self) -> bool:
        return self.passes > 0

    def cost(self, unit: str) -> float:
        return self.seconds if unit == "seconds" else float(self.passes)


@dataclass(frozen=True)
class CostStudy:
    """All cells.  agreement: |J of the plain program / J of dsim - 1|.  unit: "seconds", or "passes" untimed."""

    points: int
    steps: int
    springs: int
    cells: tuple[Cell, ...]
    agreement: float
    unit: str = "seconds"

    @property
    def methods(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(cell.method for cell in self.cells))

    @property
    def band(self) -> tuple[float, float]:
        """The A/A control's widest ratios."""
        return min(c.band[0] for c in self.cells), max(c.band[1] for c in self.cells)

    def of(self, method: str) -> tuple[Cell, ...]:
        """The cells of a method, fewest parameters first."""
        return tuple(sorted((c for c in self.cells if c.method == method), key=lambda c: c.parameters))

    def growth(self, method: str) -> float:
        """The slope of log passes over log k, as counted, from k = 10 on; nan with fewer than two points."""
        ran = [c for c in self.of(method) if c.ran and c.parameters >= SLOPE_FROM]
        if len(ran) < 2:
            return float("nan")
        slope, _ = np.polyfit(np.log([c.parameters for c in ran]), np.log([c.passes for c in ran]), 1)
        return float(slope)

    def cost(self, method: str, k: int) -> tuple[float, bool]:
        """(cost, measured).  Beyond the last k that was run the law is a + b k, through the last two that were; nan
        where only one was."""
        ran = [c for c in self.of(method) if c.ran]
        known = {c.parameters: c.cost(self.unit) for c in ran}
        if k in known:
            return known[k], True
        if len(ran) < 2:
            return float("nan"), False
        (k1, c1), (k2, c2) = list(known.items())[-2:]
        return max(c2, c2 + (c2 - c1) / (k2 - k1) * (k - k2)), False

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON's kinds."""
        parts = asdict(self) | {"band": self.band, "growth": {m: self.growth(m) for m in self.methods}}
        found: dict[str, Any] = finite(parts)
        return found


# Which methods run there does not depend on the machine
QUICK = Sweep((1, 10, 100, 1000), limit=float("inf"), most=250, rounds=1)
SHORT = Sweep((1, 10, 50, 500), limit=float("inf"), most=110, rounds=1, samples=2)


def gradient_cost(
    net: Net | None = None,
    sweep: Sweep | None = None,
    store: Store | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> CostStudy:
    """Every method at every number of parameters; each number is kept in `store` as soon as it is finished."""
    net, sweep, store = net or Net(), sweep or Sweep(), store or Store()
    cells: list[Cell] = []
    for k in sweep.counts:
        key = ("gradient cost", repr((net.points, net.steps)), repr(sweep), str(k))
        kept = store.get(*key)
        if kept is None:
            kept = {"cells": [asdict(cell) for cell in _level(net, k, sweep, cells, progress)]}
            store.put(kept, *key)
        cells += [Cell(**{**cell, "band": tuple(cell["band"])}) for cell in kept["cells"]]
    p = np.ones(1)
    agreement = abs(float(net.plain(p)) / net.value(p) - 1)
    unit = "seconds" if sweep.rounds else "passes"
    return CostStudy(net.points, net.steps, len(net.stiffness), steadied(cells), agreement, unit)


def steadied(cells: Iterable[Cell]) -> tuple[Cell, ...]:
    """Seconds = median ratio to the control x the control's least seconds: see `work_precision.steadied`."""
    cells = tuple(cells)
    base = min((cell.timing["control"] for cell in cells if cell.timing), default=1.0)
    return tuple(replace(c, seconds=base * c.timing["ratio"]) if c.timing else c for c in cells)


def _level(net: Net, k: int, sweep: Sweep, before: Sequence[Cell], progress: Callable[[str], None]) -> list[Cell]:
    """One number of parameters: errors of sampled entries first, then the whole gradients, timed side by side."""
    progress(f"{k} parameters, errors")
    cells = {name: Cell(name, k, error) for name, error in errors(net, k, sweep.samples).items()}
    chosen, work = [name for name in METHODS if _affordable(name, k, sweep, before)], dict[str, Work]()
    progress(f"{k} parameters, {'timing' if sweep.rounds else 'counting'} {len(chosen)} methods")

    def whole(name: str) -> None:
        work[name] = Work()
        METHODS[name](net, np.ones(k), np.arange(k), work[name])

    if not sweep.rounds:
        for name in chosen:
            whole(name)
        return [replace(cell, passes=work[name].passes if name in work else 0) for name, cell in cells.items()]
    timings, band = time_interleaved(
        {name: partial(whole, name) for name in chosen}, lambda: net.run(np.ones(1)), sweep.rounds
    )
    for name, timing in timings.items():
        kept = replace(cells[name], passes=work[name].passes, seconds=timing.least, timing=asdict(timing), band=band)
        cells[name] = kept
    return list(cells.values())


def _affordable(name: str, k: int, sweep: Sweep, before: Sequence[Cell]) -> bool:
    """Whether the method stays within both limits.  What was over a limit stays so."""
    mine = [c for c in before if c.method == name]
    if mine and not mine[-1].ran:
        return False
    within = _expected(mine, k, "passes") <= sweep.most
    return within and (not sweep.rounds or _expected(mine, k, "seconds") <= sweep.limit)


def _expected(mine: Sequence[Cell], k: int, unit: str) -> float:
    """The cost, with the growth between the last two k, at most proportional; 0 with fewer than two."""
    if len(mine) < 2:
        return 0.0
    (k1, c1), (k2, c2) = ((c.parameters, c.cost(unit)) for c in mine[-2:])
    return float(c2 * (k / k2) ** np.clip(np.log(c2 / c1) / np.log(k2 / k1), 0.0, 1.0))


def errors(net: Net, k: int, samples: int = 4) -> dict[str, float]:
    """Every method's error on a few entries (all of them if k is small), against complex steps in extended precision.

    Where the machine's long double is a double, the truth is the complex step itself, whose error then reads 0;
    the adjoint's, an unrelated derivation, still says how well the truth is known.
    """
    entries = np.sort(np.random.default_rng(k).permutation(k)[:samples])
    p, work = np.ones(k), Work()
    truth = complex_step(net, p, entries, work, np.clongdouble)
    scale = np.abs(truth).max()
    found = {name: method(net, p, entries, work) for name, method in METHODS.items()}
    return {name: float(np.abs(gradient - truth).max() / scale) for name, gradient in found.items()}


def cost_checks(study: CostStudy) -> list[Check]:
    """Passes grow as the laws say, and what claims all digits has them."""
    checks = [Check("plain program", "J as dsim has it", study.agreement <= 1e-13, study.agreement, "<= 1e-13")]
    for method in study.methods:
        law, found = GROWTH[method], study.growth(method)
        statement = "passes ~ parameters ^"
        checks.append(Check(method, statement, bool(abs(found - law) <= 0.1), found, f"{law} +- 0.1"))
    for method, bound in BOUNDS.items():
        error = max(cell.error for cell in study.of(method))
        checks.append(Check(method, "error of the gradient", bool(error <= bound), error, f"<= {bound:.0e}"))
    return checks
