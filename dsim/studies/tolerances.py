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
    """(tolerance, error of the state, its algebraic part) at a fixed step size.

    The algebraic part, the difference from the run with the finest tolerance, falls like the tolerance squared, since
    Newton stops one quadratic step after it was met; the error stays where only the discretization is left.
    """
    h = problem.duration / steps
    best = simulate(replace(stepper, tol=1e-14), problem.system, problem.y0, h, steps)
    rows = []
    for tol in tolerances:
        run = simulate(replace(stepper, tol=tol), problem.system, problem.y0, h, steps)
        algebraic = float(np.abs((run.y - best.y) / problem.scale).max())
        rows.append((tol, problem.state_error(run.t, run.y), algebraic))
    tol, error, algebraic = np.array(rows).T
    return tol, error, algebraic


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
