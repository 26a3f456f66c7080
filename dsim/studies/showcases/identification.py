"""Identification: the stiffness of every spring of a net, from a film of its points, with honest error bars.

Gauss-Newton (`least_squares`) on residuals with exact Jacobians.  From noise-free positions every spring is found
that can be; from noisy ones the covariance s^2 (J^T J)^-1 gives error bars, and many draws of the noise show whether
bars that claim 95 % cover the truth in 95 % of all cases.  What the film cannot tell gets an infinite bar: the spring
between two hooks, which never moves, and two springs side by side, of which only the sum acts.

Lecture: "Differentiable simulation", parameters from observations; the covariance is that of nonlinear regression
(Seber and Wild, "Nonlinear Regression", 1989, chapter 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, Springs
from dsim.gradients import Optimisation, ReducedObjective, Residuals, Variables, optimise
from dsim.scenes.nets import lattice
from dsim.scenes.scene import Scene
from dsim.simulation import SimulationError, Trajectory, simulate
from dsim.steppers import SymplecticEuler
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most, equal
from dsim.studies.showcases.model import Report, telling
from dsim.system import System

TYPICAL = 100.0  # N/m: the guess for every spring; the truth lies between a half and twice of it
NOISE = 5e-4  # m: standard deviation of an observed coordinate
LEVEL = 0.95  # of the error bars
RISK = 1e-3  # of a red check although bars are right: the limits of a count are those of the binomial distribution

STRICT: dict[str, Any] = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-6}  # to round-off, and no further

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Film:
    """A net with its true stiffness, and what a camera sees of it.  hidden (E,): springs that no film can tell.
    twins: the two springs that lie side by side."""

    scene: Scene
    truth: Array
    hidden: Mask
    twins: tuple[int, int]

    def run(self, system: System, y0: Array) -> Trajectory:
        scene = self.scene
        return simulate(scene.stepper, system, y0, scene.h, scene.steps, keep="steps")

    @cached_property
    def variables(self) -> Variables:
        return Variables(self.scene.system, self.scene.y0, ["springs.stiffness"])

    def positions(self, stiffness: Array) -> Array:
        """What the camera would see, (frames, n) m."""
        return _frames(self.run(*self.variables.place(stiffness)))

    @cached_property
    def exact(self) -> Array:
        """The film without noise."""
        return self.positions(self.truth)

    def residuals(self, film: Array) -> Residuals:
        """stiffness -> (positions - film)/NOISE, (m,)."""
        from scipy.sparse import csr_array

        size, n = self.scene.system.size, self.scene.system.n
        seen = (np.arange(1, self.scene.steps + 1)[:, None] * size + np.arange(n)).ravel()
        shape = (len(seen), (self.scene.steps + 1) * size)
        pick = csr_array((np.full(len(seen), 1 / NOISE), (np.arange(len(seen)), seen)), shape=shape)
        return Residuals(self.run, self.variables, lambda t: ((_frames(t) - film).ravel() / NOISE, pick))

    def half_squares(self, film: Array) -> ReducedObjective:
        """|r|^2/2 and its gradient by the adjoint: some ten times cheaper than the Jacobian."""

        def objective(trajectory: Trajectory) -> tuple[float, Array]:
            gap, dy = (_frames(trajectory) - film) / NOISE, np.zeros(trajectory.y.shape)
            dy[1:, : gap.shape[1]] = gap / NOISE
            return 0.5 * float((gap**2).sum()), dy

        return ReducedObjective(self.run, self.variables, objective)


def _frames(trajectory: Trajectory) -> Array:
    return trajectory.q[1:]


def net(n: int, steps: int, seed: int = 0) -> Film:
    """n x n points, 0.2 m apart, hung at two corners and shaken; each spring's stiffness is drawn log-uniformly.

    The last two springs are hidden ones: a twin of the first, and one from hook to hook.
    """
    rng = np.random.default_rng(seed)
    x, sides, diagonals = lattice((n, n), 0.2)
    hooks = [n - 1, n * n - 1]
    edges = np.concatenate([sides, diagonals, sides[:1], [hooks]])
    rest = np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    truth = TYPICAL * 2 ** rng.uniform(-1, 1, len(edges))
    effects = [Gravity([0.0, -9.81]), Springs(edges, rest, TYPICAL), Drag(0.02)]
    system = System(np.full(n * n, 0.05), effects, dimension=2, fixed=hooks)
    y0 = np.concatenate([x.ravel(), 0.5 * rng.normal(size=x.size)])
    summary = "A net whose springs differ, hung at two corners and shaken"
    scene = Scene("identification", summary, system, y0, 0.01, steps, SymplecticEuler(), edges=edges)
    hidden = np.zeros(len(edges), dtype=bool)
    hidden[[0, -2, -1]] = True
    return Film(scene, truth, hidden, (0, len(edges) - 2))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Stiffness (E,) N/m from one film, and how well it is known, from the Jacobian's singular values.

    With J diag(scale) = U S V^T the covariance in units of the scale is s^2 V S^-2 V^T; directions with S = 0 are
    unknown.  scale (E,): by default the stiffness itself.
    axes (E,r), singular (r,): V and S of the directions that are known.  noise: s, the residual's standard deviation.
    quantile: how many standard deviations a bar of LEVEL reaches (Student's t).
    """

    stiffness: Array
    axes: Array
    singular: Array
    noise: float
    unknown: Mask  # (E,): springs with a part in a direction that is not known
    quantile: float
    scale: Array

    @property
    def bars(self) -> Array:
        """Half the length of every error bar, (E,) N/m; infinite where the film says nothing."""
        spread = self.noise * np.sqrt(((self.axes / self.singular) ** 2).sum(axis=1))
        bars: Array = np.where(self.unknown, np.inf, self.quantile * self.scale * spread)
        return bars

    def covers(self, truth: Array) -> Mask:
        """Which bars reach the truth, (E,)."""
        covered: Mask = np.abs(self.stiffness - truth) <= self.bars
        return covered

    def along(self, truth: Array) -> Array:
        """The error in units of its standard deviation, along each known direction: (r,) independent numbers."""
        error: Array = self.axes.T @ ((self.stiffness - truth) / self.scale) * self.singular / self.noise
        return error


def estimate(stiffness: Array, jacobian: Array, residual: Array, scale: Array | None = None) -> Estimate:
    """The error bars of a least-squares fit.  The variance of the noise is estimated by what the fit leaves over."""
    from scipy.special import stdtrit

    scale = stiffness if scale is None else scale
    _, S, Vt = np.linalg.svd(jacobian * scale, full_matrices=False)
    known = S > 1e-10 * S[0]
    unknown = (Vt[~known] ** 2).sum(axis=0) > 1e-8
    freedom = len(residual) - int(known.sum())
    noise = float(np.sqrt(residual @ residual / freedom))
    quantile = float(stdtrit(freedom, 0.5 + LEVEL / 2))
    return Estimate(stiffness, Vt[known].T, S[known], noise, unknown, quantile, scale)


@dataclass(frozen=True, eq=False)
class Coverage:
    """How often bars reached the truth, in many draws of the noise.  hits (draws,E) of the springs' bars, along
    (draws,r) of the known directions, which are independent of each other."""

    hits: Mask
    along: Mask

    @property
    def draws(self) -> int:
        return len(self.hits)


def binomial_limits(count: int, risk: float = RISK, rate: float = LEVEL) -> tuple[float, float]:
    """Shares of hits between which `count` independent trials of this rate fall, except with probability `risk`."""
    from scipy.special import bdtr

    below = bdtr(np.arange(count + 1), count, rate)  # P(hits <= k)
    low, high = np.searchsorted(below, [risk / 2, 1 - risk / 2])
    return float(low) / count, float(high) / count


@dataclass(frozen=True, eq=False)
class Identification:
    """found (E,): from the noise-free film.  noisy: the first draw's estimate.  coverage: of all draws."""

    film: Film
    found: Array
    noisy: Estimate
    coverage: Coverage
    optimisation: Optimisation
    slope: float

    def within(self, stiffness: Array, share: float = 0.01) -> float:
        """The part of the springs that a film can tell whose stiffness is right to 1 %."""
        right = np.abs(stiffness / self.film.truth - 1) <= share
        return float(right[~self.film.hidden].mean())

    def checks(self) -> tuple[Check, ...]:
        return (*self._found(), *self._covered())

    def _found(self) -> tuple[Check, ...]:
        film, twins = self.film, list(self.film.twins)
        start = np.full(len(film.truth), TYPICAL)
        both = abs(float(self.found[twins].sum() / film.truth[twins].sum()) - 1)
        mistaken = int((np.isinf(self.noisy.bars) != film.hidden).sum())
        return (
            at_most("identification", "springs within 1 % at the start", self.within(start), 0.1),
            at_most("identification", "Jacobian against a difference", self.slope, 1e-5),
            at_least("identification", "springs within 1 %, of those seen", self.within(self.found), 0.99),
            at_most("identification", "relative error of the twins' sum", both, 0.01),
            equal("identification", "springs wrongly called known or unknown", mistaken, 0),
        )

    def _covered(self) -> tuple[Check, ...]:
        coverage, seen = self.coverage, ~self.film.hidden
        shares = coverage.hits[:, seen].mean(axis=0)
        low, high = binomial_limits(coverage.draws)  # bars of one draw depend on each other: draws are counted
        least, _ = binomial_limits(coverage.draws, RISK / len(shares))  # the worst of so many
        lower, upper = binomial_limits(coverage.along.size)
        mean, along, worst = float(shares.mean()), float(coverage.along.mean()), float(shares.min())
        name = f"identification, {coverage.draws} draws"
        return (
            Check(name, "95 % bars that reach the truth", low <= mean <= high, mean, f"{low:.3f} .. {high:.3f}"),
            at_least(name, "the same, of the worst spring", worst, least),
            Check(
                name, "95 % bars along known directions", lower <= along <= upper, along, f"{lower:.3f} .. {upper:.3f}"
            ),
        )


def run(quick: bool, report: Report | None = None) -> Identification:
    """quick: 4 x 4 points, 44 springs, 8 draws.  In full: 6 x 6 points, 112 springs, 100 draws."""
    return identified(net(4, 20), 8, report) if quick else identified(net(6, 24), 100, report)


def identified(film: Film, draws: int, report: Report | None = None) -> Identification:
    """Fit the noise-free film from one guess for all springs, then as many noisy ones."""
    start, fits = np.full(len(film.truth), TYPICAL), 20
    total = fits + draws
    exact = film.residuals(film.exact)
    told = telling(report, total, "noise-free, squares")
    found = optimise(exact, start, bounds=(TYPICAL / 100, TYPICAL * 100), max_nfev=60, report=told, **STRICT)
    noisy: list[Estimate] = []
    for draw in range(draws):
        if report is not None:
            report(min(fits, found.evaluations) + draw, total, f"draw {draw + 1} of {draws}")
        noise = NOISE * np.random.default_rng([1, draw]).normal(size=film.exact.shape)
        noisy.append(refit(film, film.exact + noise, found.p if not noisy else noisy[0].stiffness))
    hits = np.array([one.covers(film.truth) for one in noisy])
    along = np.array([np.abs(one.along(film.truth)) <= one.quantile for one in noisy])
    return Identification(film, found.p, noisy[0], Coverage(hits, along), found, _slope_error(exact, start))


def refit(film: Film, seen: Array, start: Array) -> Estimate:
    """The least-squares fit of one film, near `start`: damped Newton with the Gauss-Newton matrix of the start.

    The gradient is exact, by the adjoint: where it ends is where J^T r = 0, whatever matrix led there.
    """
    residuals, squares = film.residuals(seen), film.half_squares(seen)
    near = estimate(start, residuals.jacobian(start), residuals(start))
    stiffness, (value, gradient) = start, squares(start)
    for _ in range(30):
        steps = near.axes.T @ (start * gradient) / near.singular  # in standard deviations of each direction, times s
        if (np.abs(steps) <= 1e-3 * near.noise).all():
            break
        stiffness, value, gradient = _downhill(squares, stiffness, start * (near.axes @ (steps / near.singular)), value)
    return estimate(stiffness, residuals.jacobian(stiffness), residuals(stiffness))


def _downhill(squares: ReducedObjective, p: Array, step: Array, value: float) -> tuple[Array, float, Array]:
    """p less the step, or the half, the quarter, ... of it: the first that lowers the value; else p."""
    for shrink in 0.5 ** np.arange(20):
        try:
            found, gradient = squares(p - shrink * step)
        except SimulationError:  # too stiff for the step size
            continue
        if found <= value:
            return p - shrink * step, found, gradient
    return p, *squares(p)


def _slope_error(residuals: Residuals, p: Array, step: float = 1e-3) -> float:
    """How far the Jacobian is from a central difference of the residuals, along one direction, relatively."""
    direction = np.random.default_rng(0).normal(size=len(p))
    difference = (residuals(p + step * direction) - residuals(p - step * direction)) / (2 * step)
    return float(np.linalg.norm(residuals.jacobian(p) @ direction - difference) / np.linalg.norm(difference))
