"""Reference solutions from SciPy's integrators: competitors and referees, never steppers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsim.arrays.checks import Array
from dsim.system import Flow, System


@dataclass(frozen=True)
class Reference:
    """`scipy.integrate.solve_ivp` with a method and a relative tolerance; `atol` = rtol times the scale of y0."""

    method: str
    rtol: float = 1e-12

    @property
    def name(self) -> str:
        return f"{self.method} ({self.rtol:.0e})"

    def solve(self, system: System | Flow, y0: Array, times: Array) -> Array:
        """States (T,ny) at increasing `times`, starting from y0 at t = 0.  Raises ArithmeticError if SciPy gives up."""
        from scipy.integrate import solve_ivp

        scale = max(1.0, float(np.abs(y0).max(initial=0.0)))
        span = (0.0, float(times[-1]))
        found = solve_ivp(system.flow, span, y0, self.method, np.asarray(times), rtol=self.rtol, atol=self.rtol * scale)
        if not found.success:
            raise ArithmeticError(f"{self.name} gave up: {found.message}")
        states: Array = found.y.T
        return states


DOP853 = Reference("DOP853")
RADAU = Reference("Radau")
LSODA = Reference(
    "LSODA"
)  # multistep; at 1e-12 a hundred times quicker than Radau where the order of five is the limit


def certified(system: System | Flow, y0: Array, times: Array, other: Reference = RADAU) -> tuple[Array, float]:
    """States by DOP853 and, as their certificate, the largest difference from an unrelated method."""
    first, second = (reference.solve(system, y0, times) for reference in (DOP853, other))
    return first, float(np.abs(first - second).max())
