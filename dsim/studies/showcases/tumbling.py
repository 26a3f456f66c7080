"""Weighing by looking: the inertia of a body, six numbers, from a film of its tumbling, with error bars that hold.

Four marks on a body are seen at every step, to a millimetre.  Free tumbling tells the ratios of the six numbers, and
nothing of their size: twice the inertia tumbles alike.  Its bars are infinite, and the fit says so.  With a known
torque in the first steps all six are found, and the spin at the start, which nobody measured, with them.  Lecture:
"Rigid bodies", Euler's equations; the covariance is that of `identification`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import TorqueActuation
from dsim.effects.at_points import Markers
from dsim.effects.gyroscopic import ENTRIES
from dsim.gradients import Optimisation, Residuals, Variables, optimise
from dsim.rigid import RigidBodies
from dsim.simulation import Trajectory, simulate
from dsim.steppers import RK4
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most, equal
from dsim.studies.showcases.identification import Coverage, Estimate, binomial_limits, estimate
from dsim.studies.showcases.model import Report, telling

TRUTH = np.array([[0.8, 0.1, -0.05], [0.1, 1.1, 0.15], [-0.05, 0.15, 1.5]])  # kg m^2
SPIN = np.array([0.5, 2.0, 1.0])  # rad/s
TORQUE = np.array([0.6, -0.4, 0.8])  # N m in the body, while it is held on
MARKS = 0.3 * np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-1.0, -1.0, 0.5]])  # m from the centre
NOISE = 1e-3  # m
DURATION, PUSHED = 2.4, 0.8  # s of the film, and of the torque at its beginning
STRICT: dict[str, Any] = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-6}


@dataclass(frozen=True, eq=False)
class Sight:
    """A tumbling body and the camera: p = (the six numbers of the inertia, spin at the start) -> where marks are."""

    system: RigidBodies
    y0: Array
    steps: int

    @cached_property
    def truth(self) -> Array:
        return np.concatenate([[TRUTH[i, j] for i, j in ENTRIES], SPIN])

    @cached_property
    def guess(self) -> Array:
        """A ball of about that size, and a spin that is off by a twentieth."""
        return np.concatenate([[1.2, 1.2, 1.2, 0.0, 0.0, 0.0], 1.05 * SPIN])

    @cached_property
    def scale(self) -> Array:
        """In which the numbers are turned: 1 kg m^2 and 1 rad/s."""
        return np.ones(9)

    @cached_property
    def variables(self) -> Variables:
        return Variables(self.system, self.y0, {"inertia": ..., "velocities": [3, 4, 5]})

    def run(self, system: Any, y0: Array) -> Trajectory:
        return simulate(RK4(), system, y0, DURATION / self.steps, self.steps, keep="steps")

    @cached_property
    def _markers(self) -> Markers:
        return Markers(self.system.frame, np.zeros(len(MARKS), dtype=np.int64), MARKS)

    def seen(self, run: Trajectory) -> Array:
        """Where the marks are after every step, (steps, 12) m."""
        return np.stack([self._markers.places(q).ravel() for q in run.q[1:]])

    def residuals(self, film: Array) -> Residuals:
        """p -> (marks - film)/NOISE, and its exact Jacobian through that of the marks by the state."""
        from scipy.sparse import block_diag, csr_array, hstack

        system = self.system

        def look(run: Trajectory) -> tuple[Array, Any]:
            blocks = [self._by_state(q) / NOISE for q in run.q[1:]]
            picked = block_diag(blocks, format="csr")
            return (self.seen(run) - film).ravel() / NOISE, hstack([csr_array((picked.shape[0], system.size)), picked])

        return Residuals(self.run, self.variables, look)

    def _by_state(self, q: Array) -> Array:
        """d marks/dy (12,13): by small turns, and those by the numbers of the state."""
        frame, out = self.system.frame, np.zeros((MARKS.size, self.system.size))
        by_turn = self._markers.jacobian(q)
        for row, bar in enumerate(by_turn):
            out[row, : self.system.width] = frame.small_turn_vjp(q, bar)
        return out


def sight(steps: int, pushed: bool = True) -> Sight:
    """A body of unequal moments, its centre at rest; with or without the torque."""
    loads = np.zeros((steps, 1, 3))
    loads[: round(PUSHED * steps / DURATION), 0] = TORQUE
    system = RigidBodies([1.0], TRUTH[None], [TorqueActuation(loads, DURATION / steps, "body")] if pushed else [])
    return Sight(system, system.state([0.0, 0.0, 0.0], None, 0.0, SPIN), steps)


@dataclass(frozen=True, eq=False)
class Tumbling:
    """found (9,): from the noise-free film.  noisy: the first draw's estimate.  free: of the free body's film, whose
    size nobody can tell.  coverage: of all draws.  slope: of the Jacobian against a difference."""

    sight: Sight
    found: Array
    noisy: Estimate
    free: Estimate
    coverage: Coverage
    optimisation: Optimisation
    slope: float

    def checks(self) -> tuple[Check, ...]:
        truth, name = self.sight.truth, f"tumbling, {self.coverage.draws} draws"
        (lower, upper), (low, high) = map(binomial_limits, (self.coverage.along.size, self.coverage.draws))
        reach, known = f"{low:.3f} .. {high:.3f}", f"{lower:.3f} .. {upper:.3f}"
        shares, along = float(self.coverage.hits.mean()), float(self.coverage.along.mean())
        return (
            at_least("tumbling", "largest error at the start", float(np.abs(self.sight.guess - truth).max()), 0.3),
            at_most("tumbling", "Jacobian against a difference", self.slope, 1e-5),
            at_most("tumbling", "largest error without noise", float(np.abs(self.found - truth).max()), 1e-6),
            equal("tumbling", "numbers with infinite bars, pushed", int(self.noisy.unknown.sum()), 0),
            equal("tumbling", "directions a free body does not tell", 9 - self.free.axes.shape[1], 1),
            Check(name, "95 % bars that reach the truth", low <= shares <= high, shares, reach),
            Check(name, "95 % bars along known directions", lower <= along <= upper, along, known),
        )  # fmt: skip


def run(quick: bool, report: Report | None = None) -> Tumbling:
    """quick: 12 steps, 10 draws.  In full: 24 steps, 60 draws."""
    return weighed(12, 10, report) if quick else weighed(24, 60, report)


def weighed(steps: int, draws: int, report: Report | None = None) -> Tumbling:
    """Fit the noise-free film from the guess, then noisy ones from the truth's neighbourhood."""
    task = sight(steps)
    exact = task.seen(task.run(task.system, task.y0))
    residuals, fits = task.residuals(exact), 15
    told = telling(report, fits + draws, "noise-free, squares")
    found = optimise(residuals, task.guess, max_nfev=40, report=told, **STRICT)
    noisy, jacobian = list[Estimate](), np.asarray(residuals.jacobian(found.p))
    for draw in range(draws):
        if report is not None:
            report(min(fits, found.evaluations) + draw, fits + draws, f"draw {draw + 1} of {draws}")
        noise = NOISE * np.random.default_rng([2, draw]).normal(size=exact.shape)
        noisy.append(refit(task, exact + noise, found.p, jacobian))
    hits = np.array([one.covers(task.truth) for one in noisy])
    along = np.array([np.abs(one.along(task.truth)) <= one.quantile for one in noisy])
    free = sight(steps, pushed=False)
    film = free.seen(free.run(free.system, free.y0)) + NOISE * np.random.default_rng(5).normal(size=exact.shape)
    unpushed = free.residuals(film)
    told_free = estimate(free.truth, unpushed.jacobian(free.truth), unpushed(free.truth), free.scale)
    slope = _slope_error(residuals, task.guess)
    return Tumbling(task, found.p, noisy[0], told_free, Coverage(hits, along), found, slope)


def refit(task: Sight, film: Array, start: Array, jacobian: Array) -> Estimate:
    """Gauss-Newton near `start` with its Jacobian: four steps leave what is far below the bars.

    The bars are of that Jacobian too; that of the estimate differs from it by as little as the estimate from `start`.
    """
    residuals, p = task.residuals(film), start
    backward = np.linalg.pinv(jacobian)
    for _ in range(4):
        p = p - backward @ residuals(p)
    return estimate(p, jacobian, residuals(p), task.scale)


def _slope_error(residuals: Residuals, p: Array, step: float = 1e-4) -> float:
    """How far the Jacobian is from a central difference along one direction, relatively."""
    direction = np.random.default_rng(0).normal(size=len(p))
    difference = (residuals(p + step * direction) - residuals(p - step * direction)) / (2 * step)
    return float(np.linalg.norm(residuals.jacobian(p) @ direction - difference) / np.linalg.norm(difference))
