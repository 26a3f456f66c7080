"""Curves beside work-precision: Newton's tolerance against the error, the step of a difference against the error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.simulation import simulate
from dsim.steppers import ImplicitRuleStepper
from dsim.studies.problems import Problem

NEWTON_TOLERANCES = tuple(10.0**-k for k in range(2, 13))
DIFFERENCE_STEPS = np.logspace(-15, -1, 57)


def newton_tolerance(
    problem: Problem, stepper: ImplicitRuleStepper, steps: int, tolerances: tuple[float, ...] = NEWTON_TOLERANCES
) -> tuple[Array, Array, Array]:
    """(tolerance, error of the state, Newton iterations a step) at a fixed step size.

    The error falls with the tolerance until the discretization is all that is left: a tolerance is no error.
    """
    rows = []
    for tol in tolerances:
        run = simulate(replace(stepper, tol=tol), problem.system, problem.y0, problem.duration / steps, steps)
        rows.append((tol, problem.state_error(run.t, run.y), run.counters.newton_iterations / steps))
    tol, error, iterations = np.array(rows).T
    return tol, error, iterations


def difference_steps(steps: Array = DIFFERENCE_STEPS) -> dict[str, Array]:
    """Relative errors (K,) of the derivative of e^x sin(x)^2 at 0.9 by forward, central and complex differences.

    Truncation h f''/2 or h^2 f'''/6 against round-off eps f/h; the complex step Im f(x + ih)/h subtracts nothing
    (Squire & Trapp 1998).
    """
    x = 0.9
    exact = np.exp(x) * (np.sin(x) ** 2 + np.sin(2 * x))

    def f(z: Any) -> Any:
        return np.exp(z) * np.sin(z) ** 2

    forms: dict[str, Callable[[float], float]] = {
        "forward": lambda h: (f(x + h) - f(x)) / h,
        "central": lambda h: (f(x + h) - f(x - h)) / (2 * h),
        "complex": lambda h: f(x + 1j * h).imag / h,
    }
    return {name: np.array([abs(form(h) / exact - 1) for h in steps]) for name, form in forms.items()}
