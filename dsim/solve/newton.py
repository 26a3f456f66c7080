"""Newton's method.  Lecture: "Newton's method": approximate, solve exactly, improve, repeat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal

import numpy as np

from dsim.arrays.checks import Array, as_array, as_count, as_positive
from dsim.solve.linear import Factor, SingularMatrixError, factorize, make_definite

Globalize = Literal["none", "line_search", "energy"]
GLOBALIZATIONS = ("none", "line_search", "energy")

_SUFFICIENT = 1e-4  # Armijo's constant: the share of the predicted decrease that must be seen
_SHORTEST = 2.0**-40  # line search: the last step length tried
_ROUND_OFF = 1e-7  # below this a correction that stopped shrinking is round-off, not slow convergence


class Status(StrEnum):
    """How an iteration ended.  Only `converged` carries an answer."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "max_iterations"
    LINE_SEARCH_FAILED = "line_search_failed"
    SINGULAR = "singular"
    NOT_FINITE = "not_finite"
    UNSTABLE = "unstable"  # of an equilibrium: not a minimum of the energy
    NO_EQUILIBRIUM = "no_equilibrium"  # the energy falls for ever, or no zero of the force was found


@dataclass(frozen=True, eq=False)
class NewtonResult:
    """z (n,), why the iteration stopped, what it cost, and its history (max |residual| and correction size)."""

    z: Array
    status: Status
    iterations: int
    residuals: tuple[float, ...]
    corrections: tuple[float, ...]
    evaluations: int  # of the residual
    merits: tuple[float, ...]  # what the globalization made fall: |r|^2/2 or the energy
    factor: Factor | None  # the last factorization

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED


def newton(
    residual: Callable[[Array], Array],
    linearize: Callable[[Array], Any],
    z0: Array,
    *,
    tol: float = 1e-10,
    globalize: Globalize | Callable[[Array], float] = "line_search",
    **options: Any,
) -> NewtonResult:
    """Solve residual(z) = 0 with z <- z - alpha J(z)^-1 residual(z).

    linearize(z) returns J: (n,n) dense or sparse, or an object with `.solve(b)`.

    tol: the iteration has converged when a full correction is at most `tol` in size; by default its largest entry
    relative to max(1, max |z|) - with a quadratic rate the error left is then about tol^2.  A correction
    below 1e-7 which no longer shrinks has reached round-off and counts as converged too.

    globalize: "none" takes every step in full; "line_search" halves alpha until |residual|^2 / 2 falls
    enough (Armijo); a callable energy(z), whose gradient is the residual, is descended instead, along
    directions of J made positive definite.

    options: max_iterations (50), size (callable (correction, z) -> float: the measure that tol bounds).
    """
    problem = _Problem(residual, linearize, globalize, **options)
    tol = float(as_positive("tol", tol, ()))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return problem.iterate(as_array("z0", z0, (None,)).copy(), tol)


def relative_size(correction: Array, z: Array) -> float:
    """max |dz| / max(1, max |z|): the default measure of a correction."""
    return float(np.abs(correction).max(initial=0.0) / max(1.0, np.abs(z).max(initial=0.0)))


class _Problem:
    def __init__(
        self,
        residual: Callable[[Array], Array],
        linearize: Callable[[Array], Any],
        globalize: Globalize | Callable[[Array], float],
        max_iterations: int = 50,
        size: Callable[[Array, Array], float] = relative_size,
    ) -> None:
        if not callable(globalize) and globalize not in ("none", "line_search"):
            raise ValueError(
                f'globalize must be "none", "line_search" or an energy to descend, a callable; got {globalize!r}'
            )
        self.residual, self.linearize, self.size = residual, linearize, size
        self.energy = globalize if callable(globalize) else None
        self.search = globalize != "none"
        self.max_iterations = as_count("max_iterations", max_iterations, least=1)
        self.evaluations = 0

    def evaluate(self, z: Array) -> Array:
        self.evaluations += 1
        try:
            # A residual like x / sqrt(1 + x^2) reads 0 once x^2 overflows: that is no solution.
            with np.errstate(over="raise"):
                value = np.asarray(self.residual(z), dtype=float)
        except FloatingPointError:
            return np.full_like(z, np.nan)
        if value.shape != z.shape:
            raise ValueError(f"residual must return shape {z.shape}; got {value.shape}")
        return value

    def merit(self, z: Array, r: Array) -> float:
        return float(self.energy(z)) if self.energy else 0.5 * float(r @ r)

    def direction(self, z: Array, r: Array) -> tuple[Array, Factor]:
        jacobian = self.linearize(z)
        if not hasattr(jacobian, "solve"):
            if getattr(jacobian, "shape", None) != (len(z), len(z)):
                got = getattr(jacobian, "shape", type(jacobian).__name__)
                raise ValueError(f"linearize must return shape {(len(z), len(z))}, or an object with .solve; got {got}")
            jacobian = factorize(make_definite(jacobian) if self.energy else jacobian)
        return -jacobian.solve(r), jacobian

    def advance(self, z: Array, r: Array, dz: Array, merit: float) -> tuple[Array, Array, float, float] | None:
        """The first step length of 1, 1/2, 1/4 ... that decreases the merit enough; None if there is none.

        Differences of merits below their own round-off decide nothing: there the full step is taken.
        """
        slope = float(r @ dz) if self.energy else -2.0 * merit
        rounding = 8 * np.finfo(float).eps * abs(merit) if self.energy else 0.0
        if self.energy and slope > 0:
            return None
        alpha = 1.0
        while alpha >= _SHORTEST:
            trial = z + alpha * dz
            r_trial = self.evaluate(trial)
            if not self.search:
                return trial, r_trial, alpha, 0.5 * float(r_trial @ r_trial)
            m_trial = self.merit(trial, r_trial) if np.isfinite(r_trial).all() else np.inf
            if m_trial <= merit + _SUFFICIENT * alpha * slope + rounding:
                return trial, r_trial, alpha, m_trial
            if alpha == 1.0 and self.size(dz, z) <= _ROUND_OFF and np.isfinite(m_trial):
                return trial, r_trial, alpha, m_trial
            alpha /= 2
        return None

    def iterate(self, z: Array, tol: float) -> NewtonResult:
        r = self.evaluate(z)
        factor: Factor | None = None
        residuals, corrections = [float(np.abs(r).max(initial=0.0))], [np.inf]
        merits = [self.merit(z, r)]

        def finish(status: Status) -> NewtonResult:
            return NewtonResult(
                z, status, len(corrections) - 1, tuple(residuals), tuple(corrections[1:]),
                self.evaluations, tuple(merits), factor,
            )  # fmt: skip

        while True:
            if not np.isfinite(r).all():
                return finish(Status.NOT_FINITE)
            stalled = corrections[-1] <= _ROUND_OFF and corrections[-1] >= 0.25 * min(corrections[:-1], default=np.inf)
            # A small step proves nothing where the residual has not fallen: the scale of z may deceive.
            fallen = self.size is not relative_size or residuals[-1] <= 1e-3 * residuals[0]
            settled = len(corrections) > 3 and max(corrections[-3:]) <= tol
            if residuals[-1] == 0.0 or settled or (fallen and (corrections[-1] <= tol or stalled)):
                return finish(Status.CONVERGED)
            if len(corrections) > self.max_iterations:
                return finish(Status.MAX_ITERATIONS)
            try:
                dz, factor = self.direction(z, r)
            except SingularMatrixError:
                return finish(Status.SINGULAR)
            if not np.isfinite(dz).all():
                return finish(Status.NOT_FINITE)
            accepted = self.advance(z, r, dz, merits[-1])
            if accepted is None:
                return finish(Status.LINE_SEARCH_FAILED)
            size = self.size(dz, z)
            z, r, alpha, merit = accepted
            merits.append(merit)
            residuals.append(float(np.abs(r).max(initial=0.0)))
            # A shortened step is no evidence of convergence, however short it is.
            corrections.append(size if alpha == 1.0 else max(size, 2 * _ROUND_OFF))
