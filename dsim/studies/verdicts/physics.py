"""Second verdict: does the program's derivative converge to that of the physics?

The step is halved again and again at the same end time.  Where the true gradient is known, the error must fall.
Where it is not, the program's own states tell it: differences over a distance that does not shrink with h see the
derivative of the limit, which a limit of derivatives need not be.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.studies.verdicts.simulator import Simulator

Truth = Callable[[Array, float, Array], tuple[Array, Array]]  # (x, T, w) -> (y(T) (ny,), d(w . y(T))/dx (k,))
REFINEMENTS = (1, 2, 4, 8)
EXACT = 1e-9  # a relative error that needs no order


@dataclass(frozen=True, eq=False)
class PhysicsVerdict:
    """verdict: converges; astray, to something else; unclear; not asked, for a program with a step of its own.

    h (K,) s.  gradient_error (K,), relative, entries weighed by the size of x.  state_error (K,), relative, or None
    without a truth.  order: slope of log error over log h, of gradient and state.  doubt: how well the reference is
    known, relative.
    """

    verdict: str
    h: Array
    gradient_error: Array
    state_error: Array | None
    orders: tuple[float, float]
    doubt: float
    against: str

    def __str__(self) -> str:
        if not len(self.h):
            return self.verdict
        last = f"{self.gradient_error[-1]:.1e} off at h = {self.h[-1]:.2g} s"
        if self.verdict == "converges" and self.state_error is not None:
            return f"converges, order {self.orders[0]:.2f} (states {self.orders[1]:.2f}); {last}"
        return f"{self.verdict}: {last}, against {self.against}"


def judge_physics(
    simulator: Simulator,
    w: Array | None = None,
    truth: Truth | None = None,
    refinements: Sequence[int] = REFINEMENTS,
    seed: int = 0,
) -> PhysicsVerdict:
    """Verdict 2 on the gradient of w . y(T), T = h * steps, with h divided by each of `refinements`; () not to ask."""
    if not len(refinements):
        return PhysicsVerdict("not asked", np.empty(0), np.empty(0), None, (0.0, 0.0), 0.0, "nothing")
    if len(refinements) < 2 or any(r < 1 or r != int(r) for r in refinements):
        raise ValueError(f"refinements must be two or more whole numbers >= 1, or (); got {tuple(refinements)}")
    w = simulator.weights(seed) if w is None else w
    runs = [(simulator.h / r, simulator.steps * r) for r in refinements]
    gradients = np.stack([simulator.pulled(w, steps=steps, h=h) for h, steps in runs]) * simulator.scale
    h = np.array([h for h, _ in runs])
    if truth is None:
        return _against_differences(simulator, w, h, gradients, seed)
    y, gradient = truth(simulator.x.copy(), simulator.duration, w)
    states = np.stack([simulator.state(simulator.x, steps, h) for h, steps in runs])
    y, gradient = as_array("truth's y", y, states[0].shape), as_array("truth's gradient", gradient, simulator.x.shape)
    error, state_error = _relative(gradients, gradient * simulator.scale), _relative(states, y)
    orders = _order(h, error), _order(h, state_error)
    return PhysicsVerdict(_word(error, orders[0]), h, error, state_error, orders, 0.0, "the truth given")


def _relative(values: Array, truth: Array) -> Array:
    size = np.linalg.norm(truth) or 1.0
    error: Array = np.linalg.norm(values - truth, axis=1) / size
    return error


def _order(h: Array, error: Array) -> float:
    """Slope of log error over log h; 0 where an error is not a positive number."""
    usable = np.isfinite(error) & (error > 0)
    return float(np.polyfit(np.log(h[usable]), np.log(error[usable]), 1)[0]) if usable.sum() > 1 else 0.0


def _word(error: Array, order: float) -> str:
    if not np.isfinite(error).all():
        return "astray"
    return "converges" if error[-1] <= EXACT or (order > 0.4 and error[-1] < error[0]) else "astray"


def _against_differences(simulator: Simulator, w: Array, h: Array, gradients: Array, seed: int) -> PhysicsVerdict:
    """Along two directions: the steepest, and one of random signs."""
    k = len(simulator.x)
    steepest = gradients[-1] / (np.linalg.norm(gradients[-1]) or 1.0)
    directions = np.stack([steepest, np.random.default_rng(seed).choice([-1.0, 1.0], k) / np.sqrt(k)])
    slopes, doubts = zip(*(_limit_slope(simulator, w, d * simulator.scale, h[-2:]) for d in directions), strict=True)
    size = max(np.abs(slopes).max(), float(np.linalg.norm(gradients[-1])) / np.sqrt(k), 1e-300)
    error = np.abs(gradients @ directions.T - np.array(slopes)).max(axis=1) / size
    doubt = float(max(doubts) / size)
    against = f"differences of its states, known to {doubt:.0e}"
    word = "unclear" if doubt > 0.1 else "converges" if error[-1] <= 3 * doubt + 1e-2 else "astray"
    if not np.isfinite(error).all():
        word = "astray"
    return PhysicsVerdict(word, h, error, None, (_order(h, error), 0.0), doubt, against)


def _limit_slope(simulator: Simulator, w: Array, direction: Array, h: Array) -> tuple[float, float]:
    """d(w . y)/ds of the limit h -> 0 and its error estimate: central differences over two distances and two steps."""

    def slope(step: float, distance: float) -> float:
        steps = round(simulator.duration / step)
        ends = [simulator.state(simulator.x + s * distance * direction, steps, step) for s in (1.0, -1.0)]
        return float((ends[0] - ends[1]) @ w) / (2 * distance)

    near, far, coarse = slope(h[1], 0.01), slope(h[1], 0.02), slope(h[0], 0.01)
    change = near - coarse  # halving h again changes it by half of this in a first-order method
    doubt = abs(near - far) + abs(change)
    return (near + change, doubt) if np.isfinite(doubt) else (0.0, np.inf)


def fine_truth(method: Any, steps: int) -> Truth:
    """A truth from a method of high order with so many steps: the gradient by its own adjoint.

    method: a `Method`, for instance with `RK4`.  It is as good as its step is fine: compare with twice the steps.
    """

    def truth(x: Array, duration: float, w: Array) -> tuple[Array, Array]:
        h = duration / steps
        return method.simulate(x, steps, h), method.gradient(x, steps, h, w)

    return truth
