"""Explicit methods of higher order.  q[0], v[0] are q_n, v_n."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from dsim.steppers.rule import RuleStepper


@dataclass(frozen=True)
class VelocityVerlet(RuleStepper):
    """q1 = q0 + h v0 + h^2/2 a0,  v1 = v0 + h/2 (a0 + a1),  a1 = a(t1, q1, v0 + h a0).  Order 2.

    Symplectic without drag.  With drag the force sees v0 + h a0: had it seen the half-step velocity v0 + h/2 a0,
    the order would drop to 1.
    """

    order = 2
    form = 2
    frequency_limit = 2.0

    def rule(self, q: Any, v: Any, a: Any, t: float, h: float) -> Any:
        a0 = a(t, q[0], v[0])
        q1 = q[0] + h * v[0] + h**2 / 2 * a0
        return q1, v[0] + h / 2 * (a0 + a(t + h, q1, v[0] + h * a0))


@dataclass(frozen=True)
class RK4(RuleStepper):
    """The classical Runge-Kutta method: slopes at the start, twice in the middle, at the end.  Order 4."""

    order = 4
    frequency_limit = math.sqrt(8.0)
    rotation = "ambient"

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        k1 = phi(t, y[0])
        k2 = phi(t + h / 2, y[0] + h / 2 * k1)
        k3 = phi(t + h / 2, y[0] + h / 2 * k2)
        k4 = phi(t + h, y[0] + h * k3)
        return y[0] + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@dataclass(frozen=True)
class RKMK4(RK4):
    """RK4 in coordinates xi around the start of each step, q = q0 (x) exp(xi), xi' = dexp^-1(xi) v.  Order 4.

    For points it is RK4; bodies stay on their sphere of unit quaternions.  Munthe-Kaas, BIT 38 (1998).
    """

    rotation = "lie"
