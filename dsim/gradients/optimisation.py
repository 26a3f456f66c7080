"""Optimisers are SciPy's; here is what a user wants around them: progress, a record, and a clear end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array

Report = Callable[[int, float, float], None]  # (evaluation, value, norm of the gradient)


@dataclass(frozen=True, eq=False)
class Optimisation:
    """What an optimiser found, and its way there, one entry an evaluation.

    p (k,): the best point.  value: the objective there; for residuals |r|^2 / 2.  values, slopes (M,): the objective
    and the largest entry of its gradient at every evaluation (NaN where only the value was asked for).
    converged, message: the optimiser's own verdict.  result: SciPy's, with all it tells.
    """

    p: Array
    value: float
    values: Array
    slopes: Array
    converged: bool
    message: str
    result: Any

    def __str__(self) -> str:
        """The objective at the start and at the end, and how the search ended: p may have thousands of numbers."""
        ending = self.message.strip().capitalize().rstrip(" .:")
        return f"objective {self.values[0]:.3g} -> {self.value:.3g} in {self.evaluations} evaluations. {ending}."

    @property
    def evaluations(self) -> int:
        return len(self.values)

    @property
    def best(self) -> Array:
        """The least value up to every evaluation, (M,)."""
        return np.fmin.accumulate(self.values)


class _Recorded:
    """The objective, keeping what it answered."""

    def __init__(self, fit: Any, report: Report | None) -> None:
        self.fit, self.report = fit, report
        self.values: list[float] = []
        self.slopes: list[float] = []

    def note(self, value: float, slope: float) -> None:
        self.values.append(value)
        self.slopes.append(slope)
        if self.report is not None:
            self.report(len(self.values), value, slope)

    def value_and_gradient(self, p: Array) -> tuple[float, Array]:
        answer = self.fit(p)
        if not (isinstance(answer, tuple | list) and len(answer) == 2):
            raise ValueError(f"fit must return the tuple (value, gradient); got {answer!r:.60}")
        value, gradient = answer
        if np.isnan(value) or np.isnan(gradient).any():  # inf may pass: line searches turn back from there
            raise ValueError(f"fit must return numbers, value and gradient; NaN in evaluation {len(self.values) + 1}")
        self.note(float(value), float(np.abs(gradient).max()))
        return value, gradient

    def residual(self, p: Array) -> Array:
        r: Array = self.fit(p)
        self.note(0.5 * float(r @ r), np.nan)
        return r

    def jacobian(self, p: Array) -> Array:
        jacobian: Array = self.fit.jacobian(p)
        self.slopes[-1] = float(np.abs(jacobian.T @ self.fit(p)).max())
        return jacobian


def optimise(fit: Any, start: Any, *, method: str = "", report: Report | None = None, **options: Any) -> Optimisation:
    """Minimise a value-and-gradient callable by `scipy.optimize.minimize`, or `Residuals` by `least_squares`, and
    anything else that answers a vector and has a `.jacobian`: an array, or an operator with x_scale=1.0.

    start (k,).  method: SciPy's name, by default "L-BFGS-B", or "trf" for residuals.  report: called at every
    evaluation, for a progress line.  options: passed on, such as bounds=, tol= or options={"maxiter": 50}.
    """
    import scipy.optimize

    start, kept = as_array("start", start, (None,)), _Recorded(fit, report)
    if hasattr(fit, "jacobian"):
        result = scipy.optimize.least_squares(
            kept.residual, start, jac=kept.jacobian, method=method or "trf", **{"x_scale": "jac"} | options
        )
        value = float(result.cost)
    else:
        result = scipy.optimize.minimize(
            kept.value_and_gradient, start, jac=True, method=method or "L-BFGS-B", **options
        )
        value = float(result.fun)
    values, slopes = np.array(kept.values), np.array(kept.slopes)
    return Optimisation(result.x, value, values, slopes, bool(result.success), str(result.message), result)
