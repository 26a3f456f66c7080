"""One implicit stage,  M k = f(t, base + weights k),  solved for its rate k by Newton."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.band import BandFactor
from dsim.solve.linear import Polished, factorize
from dsim.solve.newton import NewtonResult, newton
from dsim.steppers.stepper import Counters

_NEAR = 3e-3  # iterates so much apart, relative to the largest velocity, share one factor
_DIRECTION = 1e-4  # relative residual of a direction found with the factor of another iterate


class StageProblem:
    """The residual, its matrix, and a measure of corrections; counts what they cost.

    A matrix in a band is factorized while the iterates are far apart; later directions, with the exact matrix, come
    from conjugate gradients with that factor as preconditioner.
    """

    def __init__(self, system: Any, t: float, base: tuple[Array, ...], weights: tuple[float, ...]) -> None:
        self.system, self.t, self.base, self.weights = system, t, base, weights
        self.factor: BandFactor | None = None  # of the iterate k_factor
        self._k_factor = self.base[0]
        self._polished: Polished | None = None
        self._polished_at = self.base[0]
        self._made: int | None = None  # factors, where the matrix lies in a band; else Newton makes them

    def place(self, k: Array) -> tuple[Array, ...]:
        """Where the rate is evaluated."""
        return tuple(b + w * k for b, w in zip(self.base, self.weights, strict=True))

    def residual(self, k: Array) -> Array:
        value: Array = self.system.stage_residual(k, self.t, *self.place(k))
        return value

    def size(self, dk: Array, k: Array) -> float:
        """The correction of the velocity (of y, for a flow), relative to the largest; 0 below the positions' eps."""
        gamma, largest = self.weights[-1], np.abs(self.place(k)[-1]).max()
        moved = abs(gamma) * np.abs(dk).max()
        rounding = 0.0
        if len(self.base) == 2:  # velocities below the round-off of positions, eps |q| / gamma
            start = getattr(self.system, "start", self.base[0])  # from which the positions of bodies count
            far = max(np.abs(self.base[0]).max(), np.abs(start).max())
            rounding = 4 * np.finfo(float).eps * far / abs(gamma)
        return 0.0 if moved <= rounding else float(moved / max(largest, np.finfo(float).tiny))

    def matrix(self, k: Array) -> Any:
        """M - b K - c D."""
        return self.system.stage_matrix(self.t, self.place(k), self.weights)

    def linearize(self, k: Array) -> Any:
        """The matrix, or a factor of it, or the solver that polishes with an earlier factor."""
        matrix, band = self.matrix(k), self.system.stage_band(self.weights)
        if band is None:
            return matrix
        self._adopt()
        self._made = self._made or 0
        if self.factor is not None and self.size(k - self._k_factor, k) <= _NEAR:
            self._polished, self._polished_at = Polished(matrix, band, self.factor, _DIRECTION), k
            return self._polished
        factor = factorize(matrix, band)
        self._made += 1
        self._remember(factor, k)
        return factor

    def _adopt(self) -> None:
        """Where polishing ended in a new factor, that one is the nearest now."""
        if self._polished is not None and self._polished.anew is not None:
            self._made = (self._made or 0) + 1
            self._remember(self._polished.anew, self._polished_at)
        self._polished = None

    def _remember(self, factor: Any, k: Array) -> None:
        if isinstance(factor, BandFactor):  # an LU of an indefinite matrix preconditions nothing
            self.factor, self._k_factor = factor, k.copy()

    def solve(self, stepper: Any) -> tuple[NewtonResult, Counters]:
        """From the guess k = 0, the step of a free flight."""
        descent = self.system.stage_energy(self.t, self.weights) if stepper.globalize == "energy" else None
        globalize: Any = "line_search" if stepper.globalize == "energy" else stepper.globalize
        if descent is not None:
            globalize = lambda k: descent(k, self.place(k)[0])  # noqa: E731
        result = newton(
            self.residual,
            self.matrix if descent else self.linearize,
            np.zeros(self.system.n),
            tol=stepper.tol,
            globalize=globalize,
            max_iterations=stepper.max_iterations,
            size=self.size,
        )
        self._adopt()
        n = result.iterations
        return result, Counters(result.evaluations, n, n if self._made is None else self._made, n, n)
