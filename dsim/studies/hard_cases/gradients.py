"""Hard case 45: a length whose gradient is 0/0 at 0, inside a simulation that is differentiated; and checkpoints that
restore less than they should."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, Springs
from dsim.gradients.adjoint import Gradient, adjoint
from dsim.kernels.spring import directions
from dsim.simulation import SimulationError, Trajectory, simulate
from dsim.steppers import SymplecticEuler
from dsim.steppers.checkpoints import Checkpoints
from dsim.studies.gradient_check import check_gradient
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal
from dsim.system import System


def naive_direction(edge: Array) -> Array:
    """d|e|/de = e/|e| as an automatic derivative of sqrt(e.e) forms it: 0/0 at e = 0.  edge (E,d) -> (E,d)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        direction: Array = edge / np.sqrt(np.einsum("ed,ed->e", edge, edge))[:, None]
    return direction


def safe_direction(edge: Array) -> Array:
    """d|e|/de, and 0 at e = 0: one of the subgradients, and the only one that prefers no direction."""
    return directions(edge)[1]


def library_springs() -> Springs:
    """The spring from the hook to the point, l0 = 1 m, k = 40 N/m."""
    return Springs([(0, 1)], 1.0, 40.0)


def library_checkpoints(system: Any, y0: Array, steps: int) -> Gradient:
    """Ten states kept, the steps between them taken again."""
    run = simulate(SymplecticEuler(), system, y0, 0.01, steps, keep=Checkpoints(10))
    return adjoint(run, np.ones(system.size))


def stale_checkpoint(system: Any, y0: Array, steps: int) -> Gradient:
    """One state kept half-way, of which the positions are restored; the velocities stay those of the step before."""
    kept = steps // 2
    first = simulate(SymplecticEuler(), system, y0, 0.01, kept)
    restored = np.concatenate([first.y[-1, : system.n], first.y[-2, system.n :]])
    second = adjoint(simulate(SymplecticEuler(), system, restored, 0.01, steps - kept), np.ones(system.size))
    whole = adjoint(first, second.y0)
    return Gradient(whole.y0, whole.theta + second.theta, {}, second.recomputed)


def _checkpoints(checkpointed: Callable[[Any, Array, int], Gradient]) -> tuple[float, int, int]:
    """(relative error with stale velocities, numbers unlike the full tape's, steps taken) on two tied points."""
    effects = [Gravity([0.0, -9.81]), Springs([(0, 1), (1, 2)], 0.5, [60.0, 40.0]), Drag(0.3)]
    system = System([1.0, 0.5, 0.8], effects, dimension=2, fixed=[0])
    y0, steps = np.array([0.0, 0.0, 0.6, 0.1, 0.9, -0.3, 0.0, 0.0, 0.2, 0.0, -0.4, 0.5]), 1001

    def numbers(gradient: Gradient) -> Array:
        return np.concatenate([gradient.y0, gradient.theta])

    whole = numbers(adjoint(simulate(SymplecticEuler(), system, y0, 0.01, steps), np.ones(system.size)))
    stale = numbers(stale_checkpoint(system, y0, steps))
    found = checkpointed(system, y0, steps)
    error = float(np.abs(stale - whole).max() / np.abs(whole).max())
    return error, int((numbers(found) != whole).sum()), steps + found.recomputed


def norm_at_zero(
    full: bool = False,
    direction: Callable[[Array], Array] = safe_direction,
    springs: Callable[[], Any] = library_springs,
    checkpointed: Callable[[Any, Array, int], Gradient] = library_checkpoints,
) -> HardCaseResult:
    """J = |x_1| + |x_2| + |x_3| with x_2 = 0: one NaN is enough to make a whole pulled-back gradient NaN.

    dJ/da with x_i = a_1 + a_2 x_i' sums all three rows, so that the naive gradient has no finite entry.  The
    simulation starts with both ends of a spring in one place, and its adjoint is held against differences.
    """
    x = np.array([[0.3, -0.4], [0.0, 0.0], [-0.6, 0.8]])
    pull = np.array([[1.0, 1.0, 1.0], [0.5, 2.0, -1.0]])  # dx/da
    naive, safe = pull @ naive_direction(x), pull @ direction(x)
    truth = pull[:, [0, 2]] @ np.array([[0.6, -0.8], [-0.6, 0.8]])
    at_zero = float(np.abs(direction(np.zeros((1, 2)))).max())
    offsets = np.linspace(-1, 1, 41)
    line = np.stack([offsets, np.zeros(41)], axis=1)
    slopes = [function(line)[:, 0] for function in (naive_direction, direction)]
    verdict = check_gradient(lambda z: float(np.linalg.norm(z)), np.zeros(2), direction(np.zeros((1, 2)))[0]).verdict
    gradient, confirmed = _simulated(springs)
    entries, defined = np.isfinite(naive).sum(), np.isfinite(naive_direction(np.zeros((1, 2)))).any()
    finite = all(np.isfinite(part).all() for part in gradient)
    close = float(np.abs(safe - truth).max())
    gap = np.abs(offsets) > 0
    stale, kept, again = _checkpoints(checkpointed)
    return HardCaseResult(
        (
            equal("naive gradient of |x|", "finite entries of the pulled-back gradient", float(entries), 0),
            equal("naive gradient of |x|", "finite at 0", float(defined), 0),
            at_least("checkpoint with stale velocities", "relative error of the gradient", stale, 1e-2),
        ),
        (
            equal("safe gradient of |x|", "its value at 0", at_zero, 0),
            at_most("safe gradient of |x|", "the other points' share of the gradient", close, 1e-15),
            equal("check_gradient", 'says "kink" at 0: a subgradient, not a derivative', float(verdict == "kink"), 1),
            equal("adjoint from coincident ends", "all entries finite", float(finite), 1),
            equal("adjoint from coincident ends", "differences of the simulation agree", float(confirmed), 1),
            equal("10 snapshots, 1001 steps", "bits of the gradient unlike the full tape's", float(kept), 0),
            at_most("10 snapshots, 1001 steps", "steps taken, run and way back", float(again), 3641),
        ),
        (
            Panel("Naive: x/|x|", "x (m)", "d|x|/dx", (Curve("gradient", line[gap, 0], slopes[0][gap], True),),
                  "NaN at 0: no point there"),
            Panel("Safe: 0 at 0", "x (m)", "d|x|/dx", (Curve("gradient", line[gap, 0], slopes[1][gap], True),
                  Curve("at 0", line[~gap, 0], slopes[1][~gap], True)), "0 at 0, one of the subgradients"),
        ),
        (f"{np.isnan(naive).sum()} of {naive.size} NaN; stale checkpoint off by {stale:.0%}",
         f"{at_zero:g} at 0, all finite; {kept} of the bits differ", "0 at 0, finite; 0 bits"),
    )  # fmt: skip


def _simulated(springs: Callable[[], Any]) -> tuple[tuple[Array, ...], bool]:
    """(dJ/dtheta, dJ/dy0) of J = |q_N - target|^2 / 2 by the adjoint, and whether differences confirm the first.

    The point starts in the hook of its spring and leaves downward whatever theta is: by theta J is smooth.
    By y0 it is not, so that part is only asked to be finite.
    """
    system = System([1.0, 1.0], [Gravity([0.0, -9.81]), springs()], dimension=2, fixed=[0])
    h, steps, target = 0.01, 30, np.array([0.3, -0.7])

    def run(theta: Array) -> Trajectory:
        return simulate(SymplecticEuler(), system.with_theta(theta), np.zeros(8), h, steps)

    def objective(theta: Array) -> float:
        return 0.5 * float(((run(theta).q[-1, 2:] - target) ** 2).sum())

    try:
        trajectory = run(system.theta)
    except SimulationError:  # the spring is NaN: so is the gradient
        return (np.array([np.nan]),), False
    weights = np.zeros_like(trajectory.y)
    weights[-1, 2:4] = trajectory.q[-1, 2:] - target
    gradient = adjoint(trajectory, weights)
    return (gradient.theta, gradient.y0), check_gradient(objective, system.theta, gradient.theta).ok
