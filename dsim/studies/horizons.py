"""Programs whose derivatives are known and not always of use: a chaotic map, a particle that drag brings to rest, and
a ball over a wall."""

from __future__ import annotations

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.effects import Drag
from dsim.gradients.objectives import Variables
from dsim.steppers import SymplecticEuler
from dsim.studies.smoothing import Wall
from dsim.studies.verdicts.simulator import Method, Simulator
from dsim.system import System

ANGLE = 0.3  # x_0 = sin^2(0.3)


def logistic_state(x0: float, n: int) -> Array:
    """x_0, ..., x_n of x -> 4 x (1 - x), in the precision of floats."""
    x = np.empty(n + 1)
    x[0] = x0
    for k in range(n):
        x[k + 1] = 4 * x[k] * (1 - x[k])
    return x


def logistic_slopes(x0: float, n: int) -> Array:
    """dx_k/dx_0 for k = 0, ..., n by the chain rule: the product of 4 (1 - 2 x)."""
    return np.concatenate([[1.0], np.cumprod(4 * (1 - 2 * logistic_state(x0, n)[:-1]))])


def logistic_truth(n: int, angle: float = ANGLE) -> tuple[Array, Array]:
    """x_k = sin^2(2^k a) and dx_k/dx_0 = 2^k sin(2^(k+1) a) / sin(2 a): 2^k a is exact in floats, and its sine good."""
    power = 2.0 ** np.arange(n + 1)
    return np.sin(power * angle) ** 2, power * np.sin(2 * power * angle) / np.sin(2 * angle)


def logistic(n: int) -> Simulator:
    """n steps of the map from sin^2(0.3); h means nothing to it."""

    def simulate(x: Array, steps: int, h: float) -> Array:
        return logistic_state(float(x[0]), steps)[-1:]

    def gradient(x: Array, steps: int, h: float, w: Array) -> Array:
        return w * logistic_slopes(float(x[0]), steps)[-1:]

    return Simulator(f"logistic map, {n} steps", as_array("x0", [np.sin(ANGLE) ** 2]), simulate, gradient, 1.0, n)


def damped_slope(c: float, h: float = 1e-3, updates: int = 999, exponential: bool = True) -> float:
    """dx/dv_0 of v *= b, x += h v, repeated: h (b + b^2 + ...) = h b (1 - b^n)/(1 - b), and h n without drag.

    b = e^(-c h) for the exponential decay, 1 - c h for the Euler step.
    """
    b = np.exp(-c * h) if exponential else 1 - c * h
    return float(h * updates if c == 0 else h * b * (1 - b**updates) / (1 - b))


def damped(c: float, h: float = 1e-3, updates: int = 999) -> Simulator:
    """A particle of 1 kg with drag c under symplectic Euler, x by v_0: never beyond 1/c, however long it flies."""
    system = System([1.0], [Drag(c)], dimension=1)
    method = Method(SymplecticEuler(), Variables(system, np.array([0.0, 1.0]), ["velocities"]))
    return Simulator(f"drag {c:g} kg/s", method.variables.start, method.simulate, method.gradient, h, updates)


def over_the_wall(theta: float = 0.72) -> Simulator:
    """The throw of `smoothing.Wall`: J by the angle, right in every digit and blind to the wall's edge."""
    wall = Wall()

    def simulate(x: Array, steps: int, h: float) -> Array:
        return wall.line(float(x[0]))(np.zeros(1))[0]

    def gradient(x: Array, steps: int, h: float, w: Array) -> Array:
        return w * wall.line(float(x[0]))(np.zeros(1))[1]

    return Simulator("ball over a wall", as_array("theta", [theta]), simulate, gradient, 1.0, 1)
