"""The Euler methods.  Lecture: "Time stepping" and "Explicit vs. implicit time integration".

Indices are the subscripts of the notes: y[0] is y_n, y[1] is y_{n+1}, y[-1] is y_{n-1}.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dsim.steppers.rule import ImplicitRuleStepper, RuleStepper


@dataclass(frozen=True)
class ForwardEuler(RuleStepper):
    """y_{n+1} = y_n + h phi(t_n, y_n).  Order 1; blows up when h is too large."""

    order = 1
    frequency_limit = 0.0

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        return y[0] + h * phi(t, y[0])


@dataclass(frozen=True)
class SymplecticEuler(RuleStepper):
    """The lecture's "simplest strategy": v_{n+1} = v_n + h a(t_n, q_n, v_n), then q_{n+1} = q_n + h v_{n+1}.

    Order 1; without drag it conserves a modified energy, and is stable for h w < 2.
    """

    order = 1
    form = 2
    frequency_limit = 2.0

    def rule(self, q: Any, v: Any, a: Any, t: float, h: float) -> Any:
        v1 = v[0] + h * a(t, q[0], v[0])
        return q[0] + h * v1, v1


@dataclass(frozen=True)
class NormalisedEuler(SymplecticEuler):
    """The notes' loop for bodies: v and omega first, then x + h v and q + h qdot, and q divided by its norm.

    That turns by 2 atan(h |omega|/2), the Cayley map, instead of by h |omega|.  For points it is `SymplecticEuler`.
    """

    rotation = "cayley"


@dataclass(frozen=True)
class BackwardEuler(ImplicitRuleStepper):
    """y_{n+1} = y_n + h phi(t_{n+1}, y_{n+1}).  Order 1; stable for every h, and dissipative."""

    order = 1

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        return y[0] + h * phi(t + h, y[1])


@dataclass(frozen=True)
class TwoStepBackwardEuler(ImplicitRuleStepper):
    """q_{n+1} = 2 q_n - q_{n-1} + h^2 a(t_{n+1}, q_{n+1}, (q_{n+1} - q_n)/h): backward Euler without velocities.

    The made-up past q_{-1} = q_0 - h v_0 makes it the same method as `BackwardEuler` from the first step on.
    """

    order = 1
    form = 2
    history = 2

    def rule(self, q: Any, v: Any, a: Any, t: float, h: float) -> Any:
        v1 = (q[1] - q[0]) / h
        return 2 * q[0] - q[-1] + h**2 * a(t + h, q[1], v1), v1
