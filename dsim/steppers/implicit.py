"""Implicit methods of order 2.  Indices are the subscripts of the notes: y[1] is y_{n+1}."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dsim.steppers.rule import ImplicitRuleStepper


@dataclass(frozen=True)
class ImplicitMidpoint(ImplicitRuleStepper):
    """y_{n+1} = y_n + h phi(t_n + h/2, (y_n + y_{n+1})/2).  Order 2, symplectic, A-stable.

    Bodies turn by the Cayley map, which keeps the angular momentum of free ones, and that of tied ones to O(h^2).
    Hairer, Lubich, Wanner, Geometric Numerical Integration, II.1.1.
    """

    order = 2
    rotation = "cayley"

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        return y[0] + h * phi(t + h / 2, (y[0] + y[1]) / 2)


@dataclass(frozen=True)
class Trapezoidal(ImplicitRuleStepper):
    """y_{n+1} = y_n + h/2 (phi(t_n, y_n) + phi(t_{n+1}, y_{n+1})).  Order 2, A-stable, undamped at infinity."""

    order = 2

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        return y[0] + h / 2 * (phi(t, y[0]) + phi(t + h, y[1]))


@dataclass(frozen=True)
class BDF2(ImplicitRuleStepper):
    """y_{n+1} = 4/3 y_n - 1/3 y_{n-1} + 2/3 h phi(t_{n+1}, y_{n+1}).  Order 2, A-stable and damped at infinity.

    With the made-up past y_{-1} = y_0 - h phi(t_0, y_0) the first step is the theta method with theta = 2/3,
    whose single error of order h^2 leaves the method at order 2.  Hairer, Wanner, Solving ODEs II, V.1.
    """

    order = 2
    history = 2

    def rule(self, y: Any, phi: Any, t: float, h: float) -> Any:
        return (4 * y[0] - y[-1]) / 3 + 2 / 3 * h * phi(t + h, y[1])
