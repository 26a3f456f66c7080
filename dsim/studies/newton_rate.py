"""Newton's quadratic rate on a step of a stiff spring net, and how a slip in the Jacobian loses it."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Gravity, Springs
from dsim.solve.newton import NewtonResult, newton
from dsim.system import System


def stiff_net() -> System:
    """Six points on a ring of springs with h^2 k/m = 10, stretched unevenly."""
    pairs = [(i, (i + 1) % 6) for i in range(6)] + [(0, 3), (1, 4)]
    return System(np.full(6, 0.5), (Gravity([0.0, -9.81]), Springs(pairs, 1.0, 2000.0)), dimension=2, fixed=(0,))


def solve_step(scale: float = 1.0, globalize: Any = "none", h: float = 0.05) -> NewtonResult:
    """One backward Euler step of `stiff_net` in its accelerations; `scale` multiplies the force Jacobian."""
    system = stiff_net()
    angles = np.arange(6) * np.pi / 3
    q0 = np.stack([1.1 * np.cos(angles), 0.9 * np.sin(angles)], axis=1).ravel()
    v0 = np.zeros(system.n)

    def place(k: Array) -> tuple[Array, Array]:
        v = v0 + h * k
        return q0 + h * v, v

    return newton(
        lambda k: system.stage_residual(k, h, *place(k)),
        lambda k: system.stage_matrix(h, place(k), (scale * h**2, scale * h)),
        np.zeros(system.n),
        tol=1e-13,
        globalize=globalize,
    )


def rate(result: NewtonResult, floor: float = 1e-11) -> float:
    """The order of convergence from the last corrections above round-off: 2 is quadratic, 1 linear."""
    c = np.array([value for value in result.corrections if value > floor])
    if len(c) < 3:
        return float("nan")
    return float(np.log(c[-1] / c[-2]) / np.log(c[-2] / c[-3]))
