"""The seam between a method and everything that uses it: Step, Stepper, Linearization."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.newton import Status
from dsim.system import Flow, System

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from dsim.solve.band import BandFactor

Ode = System | Flow

FACTOR_BYTES = 2**30  # keep="factors": steps beyond this budget are factorized again on the way back


@dataclass(frozen=True)
class Counters:
    """What steps cost, in evaluations.  Counters add."""

    forces: int = 0
    jacobians: int = 0
    factorizations: int = 0
    solves: int = 0
    newton_iterations: int = 0

    def __add__(self, other: Counters) -> Counters:
        return Counters(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass(frozen=True, eq=False)
class Step:
    """One step taken: all that is needed to linearize it again.

    y0, y1: the states before and after, with the history that a multistep method carries.
    unknowns: what the residual was solved for, here y1.  rates (S,n): k of every stage, or None after
    loading, when `linearize` evaluates them again.  factors: of stages whose matrix lies in a band, the factor of
    an iterate near the solution, for `linearize` to start from.
    """

    t: float
    h: float
    y0: Array
    y1: Array
    status: Status = Status.CONVERGED
    counters: Counters = Counters()
    rates: tuple[Array, ...] | None = None
    factors: Mapping[int, BandFactor | None] | None = None

    @property
    def unknowns(self) -> Array:
        return self.y1

    @property
    def factor_bytes(self) -> int:
        """Memory of the factors."""
        return sum(factor.nbytes for factor in (self.factors or {}).values() if factor is not None)


class Linearization(Protocol):
    """A = dR/dz, B = dR/dy0, C = dR/dtheta of a step's residual R(z; y0, theta) = 0, and what follows."""

    @property
    def A(self) -> csr_array: ...
    @property
    def B(self) -> csr_array: ...
    @property
    def C(self) -> csr_array: ...

    def tangent(self, dy0: Array, dtheta: Array) -> Array:
        """dy1 = -A^-1 (B dy0 + C dtheta); dy0 (ny,), dtheta (P,), or k columns of each."""
        ...

    def pullback(self, mu: Array, theta_bar: Array) -> Array:
        """dJ/dy0 = -B^T A^-T mu from mu = dJ/dy1; adds -C^T A^-T mu into theta_bar in place."""
        ...


class SecondOrder(Linearization, Protocol):
    """A linearization whose pullback can be differentiated, for Hessian-vector products."""

    def push(self, dy0: Array, dtheta: Array) -> tuple[Array, Any]:
        """`tangent`, and the changes inside the step, for `pullback_tangent`."""
        ...

    def pullback_tangent(self, mu: Array, changes: Any, dtheta: Array, theta_bars: tuple[Array, Array]) -> Array:
        """`pullback` of mu[:, 0], and its derivative in the direction of a `push` and of dmu = mu[:, 1]."""
        ...


class Stepper(Protocol):
    """A time-stepping method: a pure function of (system, t, y0, h), and its linearization."""

    @property
    def order(self) -> int:
        """Order of accuracy on smooth problems."""
        ...

    @property
    def history(self) -> int:
        """Past states a step needs: 1, or 2 for the two-step methods."""
        ...

    def start(self, system: Ode, t: float, y0: Array, h: float) -> Step:
        """From the user's y0 to the state that `step` takes: y0 itself, or y0 with a made-up past."""
        ...

    def step(self, system: Ode, t: float, y0: Array, h: float) -> Step:
        """One step from t to t + h."""
        ...

    def residual(self, system: Ode, step: Step) -> Array:
        """R(step.unknowns; step.y0, theta), 0 at a solved step."""
        ...

    def linearize(self, system: Ode, step: Step) -> Linearization:
        """The residual's linearization at the step; never projected."""
        ...


def check_state(y0: Array, size: int, history: int) -> Array:
    """y0 as floats (history * size,), or ValueError."""
    y0 = np.asarray(y0, dtype=float)
    if y0.shape != (history * size,):
        hint = "; pass it through `start` first" if history > 1 and y0.shape == (size,) else ""
        raise ValueError(f"y0 must have shape ({history * size},); got {y0.shape}{hint}")
    return y0
