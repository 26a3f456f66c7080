"""Observed order of accuracy: errors against a reference over a sweep of step sizes, and the slope with its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.simulation import simulate
from dsim.steppers.stepper import Stepper
from dsim.studies.check import Check
from dsim.studies.reference import RADAU, Reference, certified
from dsim.studies.steps import river
from dsim.system import Flow, System

COMPARISONS = 20  # comparison times in [0, T]; not whole periods: there symplectic Euler would show order 2
REFINEMENTS = (1, 1.5, 2, 3, 4, 6)  # step counts over the coarsest one


@dataclass(frozen=True, eq=False)
class OrderProblem:
    """A smooth initial value problem on [0, T] with its true states (20,ny) at T/20, 2T/20, ..., T.

    certificate: how well the truth is known; errors below ten times that say nothing and are left out.
    coarsest: steps of the coarsest run, a multiple of 40.
    """

    name: str
    system: System | Flow
    y0: Array
    duration: float
    truth: Array
    certificate: float = 0.0
    coarsest: int = 40


def with_reference(
    name: str, system: System | Flow, y0: Array, duration: float, other: Reference = RADAU
) -> OrderProblem:
    """A problem without a closed form: two unrelated SciPy integrators stand in for the truth."""
    times = duration * np.arange(1, COMPARISONS + 1) / COMPARISONS
    states, certificate = certified(system, y0, times, other)
    return OrderProblem(name, system, np.asarray(y0, dtype=float), duration, states, certificate)


def with_solution(name: str, system: System | Flow, exact: Callable[[float], Array], duration: float) -> OrderProblem:
    """A problem with a closed form t -> y (ny,)."""
    times = duration * np.arange(1, COMPARISONS + 1) / COMPARISONS
    return OrderProblem(name, system, exact(0.0), duration, np.stack([exact(t) for t in times]))


@dataclass(frozen=True, eq=False)
class OrderFit:
    """error ~ C h^order: slope of log error over log h with its standard error and R^2, and the points."""

    order: float
    standard_error: float
    r_squared: float
    h: Array
    error: Array


def fit_order(h: Array, error: Array) -> OrderFit:
    """Least squares through (log h, log error).  Raises ValueError unless >= 3 positive finite points are given."""
    h, error = np.asarray(h, dtype=float), np.asarray(error, dtype=float)
    if len(h) < 3 or not (np.isfinite(error).all() and (error > 0).all() and (h > 0).all()):
        raise ValueError(f"h and error must be at least 3 positive finite numbers; got {h}, {error}")
    x, y = np.log(h), np.log(error)
    design = np.stack([x, np.ones_like(x)], axis=1)
    (slope, offset), *_ = np.linalg.lstsq(design, y, rcond=None)
    residual = y - slope * x - offset
    spread, total = float(residual @ residual), float(((y - y.mean()) ** 2).sum())
    error_of_slope = np.sqrt(spread / (len(x) - 2) / ((x - x.mean()) ** 2).sum())
    return OrderFit(float(slope), float(error_of_slope), 1 - spread / total if total else 0.0, h, error)


def observed_order(stepper: Stepper, problem: OrderProblem) -> OrderFit:
    """The order from six step sizes: the largest error over 20 times of [0, T], fitted in log-log."""
    sizes, errors = [], []
    for refinement in REFINEMENTS:
        steps = int(problem.coarsest * refinement)
        stride = steps // COMPARISONS
        trajectory = simulate(stepper, problem.system, problem.y0, problem.duration / steps, steps)
        error = np.abs(trajectory.y[stride::stride] - problem.truth).max()
        if error > 10 * problem.certificate:
            sizes.append(trajectory.h)
            errors.append(error)
    return fit_order(np.array(sizes), np.array(errors))


def check_order(stepper: Any, problem: OrderProblem) -> tuple[Check, OrderFit]:
    """Passes when the observed order is the declared one to 0.1 with R^2 >= 0.999."""
    fit = observed_order(stepper, problem)
    passed = abs(fit.order - stepper.order) <= 0.1 and fit.r_squared >= 0.999
    statement = f"observed order ({problem.name})"
    return Check(type(stepper).__name__, statement, passed, fit.order, f"{stepper.order} +- 0.1"), fit


def pendulum_in_wind() -> OrderProblem:
    """A spring pendulum in 2-D with gravity, spring damping and drag in a steady wind; nothing is periodic."""
    effects = (
        Gravity([0.0, -9.81]),
        Drag(0.4, wind=[1.0, 0.0]),
        Springs([(0, 1)], rest_length=1.0, stiffness=20.0),
        SpringDamping([(0, 1)], coefficient=0.3),
    )
    system = System([1.0, 1.0], effects, dimension=2, fixed=[0])
    return with_reference("pendulum in wind", system, np.array([0.0, 0, 1, 0, 0, 0, 0, 0]), duration=1.0)


def leaf_in_river() -> OrderProblem:
    """A leaf in a swirling, pulsating river, a first-order flow."""
    problem = river()
    return with_reference("leaf in a river", problem.system, problem.y0, duration=2.0)
