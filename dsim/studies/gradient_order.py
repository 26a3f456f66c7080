"""Does the gradient converge like the state?  Where the force is smooth, yes; at a kink order 1; at a jump no.

The adjoint is the exact derivative of the program.  What that derivative converges to is another question: a step that
crosses a kink or a jump of the force has a small error in the state, and one that is larger by 1/h in its derivative.
All three problems have closed forms.  Kink and jump are crossed after a third of the time: a third or two thirds into
a step when the number of steps is a power of two, never at its end.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Field
from dsim.steppers import RK4, ImplicitMidpoint, SymplecticEuler, VelocityVerlet
from dsim.studies.check import Check
from dsim.studies.problems import Problem
from dsim.studies.work_precision import QUANTITIES, Study, Sweep
from dsim.system import System

METHODS = (SymplecticEuler(), ImplicitMidpoint(), VelocityVerlet(), RK4())
EXPLICIT = (SymplecticEuler(), VelocityVerlet(), RK4())  # at a jump Newton may have nothing to converge to
SWEEP = Sweep(levels=7, costly=5, rounds=0)
SHORT = Sweep(levels=4, costly=3, rounds=0)


@lru_cache(maxsize=1)
def marble_in_a_bowl() -> Problem:
    """The distance x from the axis of a marble that circles in a bowl: f = -x + 1/x^3, k = m = L = 1; smooth.

    In the plane the motion is (x0 cos t + v0 sin t, sin t / x0), and x is its length; from x = 3/2 at rest to t = 4.
    """
    start, duration, tiny = np.array([1.5, 0.0]), 4.0, 1e-30

    def motion(y0: Array, t: float) -> Array:
        cos, sin = np.cos(t), np.sin(t)
        along, across = y0[0] * cos + y0[1] * sin, sin / y0[0]
        x = np.sqrt(along**2 + across**2)
        return np.array([x, (along * (y0[1] * cos - y0[0] * sin) + across * cos / y0[0]) / x])

    bowl = Field(
        lambda x: -x + x**-3,
        lambda x: (-1 - 3 * x**-4)[:, :, None],
        lambda x: (x[:, 0] ** 2 + x[:, 0] ** -2) / 2,
        name="bowl",
    )
    slope = np.stack([motion(start + 1j * tiny * e, duration).imag / tiny for e in np.eye(2)], axis=1)
    return _problem("marble-in-a-bowl", bowl, lambda t: motion(start, t), duration, slope)


@lru_cache(maxsize=1)
def slack_band() -> Problem:
    """A point on a rubber band that goes slack: f = -max(x, 0), k = m = 1; from x = 1 at rest to t = 3 pi/2.

    x = cos t until pi/2, then pi/2 - t.  The force is continuous, so dy(T)/dy0 is a product,
    [[1, T - pi/2], [0, 1]] [[0, 1], [-1, 0]].
    """
    crossing, duration = np.pi / 2, 1.5 * np.pi

    def exact(t: float) -> Array:
        return np.array([np.cos(t), -np.sin(t)] if t < crossing else [crossing - t, -1.0])

    band = Field(
        lambda x: -np.maximum(x, 0.0),
        lambda x: -np.where(x > 0, 1.0, 0.0)[:, :, None],
        lambda x: np.maximum(x[:, 0], 0.0) ** 2 / 2,
        name="band",
    )
    slope = np.array([[1.0, duration - crossing], [0.0, 1.0]]) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    return _problem("slack-band", band, exact, duration, slope)


@lru_cache(maxsize=1)
def edge_of_a_fan() -> Problem:
    """A point that a fan pushes back, f = -1 where x > 0 and 0 elsewhere, m = 1; from x = 1 at rest to t = 3 sqrt(2).

    x = x0 + v0 t - t^2/2 until the crossing t_c = v0 + s, s = sqrt(v0^2 + 2 x0), then -s (t - t_c).  Hence
    dx(T)/dx0 = 1 - (T - t_c)/s = -1.  Every program that steps across without looking for t_c says +1: its derivative
    does not see the jump, however small h.
    """
    speed = np.sqrt(2.0)
    duration = 3 * speed

    def exact(t: float) -> Array:
        return np.array([1 - t**2 / 2, -t] if t < speed else [-speed * (t - speed), -speed])

    fan = Field(
        lambda x: -np.where(x > 0, 1.0, 0.0),
        lambda x: np.zeros((*x.shape, 1)),
        lambda x: np.maximum(x[:, 0], 0.0),
        name="fan",
    )
    after = duration - speed
    slope = np.array([[1 - after / speed, speed], [-1 / speed, 0.0]])
    return _problem("edge-of-a-fan", fan, exact, duration, slope)


def _problem(name: str, field: Field, exact: Callable[[float], Array], duration: float, slope: Array) -> Problem:
    system = System([1.0], [field], dimension=1)
    return Problem(name, system, exact(0.0), duration, exact, lambda mu: slope.T @ mu)


def order_checks(smooth: Study, kink: Study, jump: Study) -> list[Check]:
    """Equal orders where the force is smooth; 2 and 1 at a kink; 1 and an error that stays at a jump."""
    checks = []
    for method in ("SymplecticEuler", "ImplicitMidpoint", "VelocityVerlet", "RK4"):
        lost = observed(smooth, method, "state") - observed(smooth, method, "gradient")
        statement = f"orders of state and gradient on {smooth.problem}, difference"
        checks.append(Check(method, statement, bool(abs(lost) <= 0.35), lost, "0 +- 0.35"))
    expected = [(kink, "VelocityVerlet", 2, "state"), (kink, "VelocityVerlet", 1, "gradient"),
                (kink, "RK4", 1, "gradient"), (jump, "VelocityVerlet", 1, "state")]  # fmt: skip
    for study, method, order, quantity in expected:
        found = observed(study, method, quantity)
        passed = bool(abs(found - order) <= 0.15)
        checks.append(Check(method, f"order of the {quantity} on {study.problem}", passed, found, f"{order} +- 0.15"))
    left = min(cell.gradient_error for cell in jump.cells)
    checks.append(Check(jump.problem, "the gradient stays wrong for every h", left > 1, left, "> 1"))
    return checks


def observed(study: Study, method: str, quantity: str) -> float:
    """The order on the window in which the error falls; where it does not fall, the slope over all h, about 0."""
    if fit := study.order(method, quantity):
        return fit.order
    cells = [cell for cell in study.of(method) if not cell.failed]
    errors = np.array([max(cell.error_of(quantity), 1e-300) for cell in cells])
    return float(np.polyfit(np.log([cell.setting for cell in cells]), np.log(errors), 1)[0])


def order_rows(study: Study) -> list[tuple[str, str, str, float, float]]:
    """(method, order of the state, order of the gradient, both errors at the finest h), steppers alone."""
    rows = []
    for method in study.methods:
        cells = [cell for cell in study.of(method) if cell.steps and not cell.failed]
        if cells:
            orders = [f"{observed(study, method, quantity):.2f}" for quantity in QUANTITIES]
            rows.append((method, *orders, cells[-1].error, cells[-1].gradient_error))
    return rows  # type: ignore[return-value]
