"""Directional derivatives from values on a line, by central differences of order 4:

    f'(0) = [ 8 (f(s) - f(-s)) - (f(2s) - f(-2s)) ] / (12 s) + O(s^4)

The first derivative of smooth values comes to about ten digits, a second one (nested) to about nine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsim.arrays.checks import Array

FIRST = float(np.cbrt(np.finfo(float).eps))  # relative steps: 6e-6, as for the Jacobians
SECOND = float(np.finfo(float).eps ** 0.2)  # and 7e-4 where differences are differenced again

PointMap = Callable[[Array], Array]


def slope(f: Callable[[float], Array], step: float) -> Array:
    """f'(0) for f: number -> array."""
    value: Array = (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)
    return value


def line_length(*lines: tuple[Array, Array]) -> float:
    """The largest entry of dx relative to max(1, |x|), over pairs (x, dx)."""
    return max(float((np.abs(dx) / np.maximum(1.0, np.abs(x))).max(initial=0.0)) for x, dx in lines)


def change_of_jacobian(jacobian: PointMap, x: Array, dx: Array) -> Array:
    """The change of J = jacobian(x) (N,d,d) along dx, for x and dx (N,d); point i depends on x_i alone."""
    size, u = _scaled(x, dx)
    return size[:, :, None] * slope(lambda s: jacobian(x + s * u), FIRST)


def change_of_slopes(f: PointMap, x: Array, dx: Array) -> Array:
    """`change_of_jacobian` of the jacobian of f: (N,d) -> (N,d), from values of f alone: 16 d evaluations."""
    size, u = _scaled(x, dx)
    columns = []
    for axis in range(x.shape[1]):
        b = np.zeros_like(x)
        b[:, axis] = np.maximum(1.0, np.abs(x[:, axis]))

        def along(s: float, b: Array = b) -> Array:
            return slope(lambda r: f(x + s * u + r * b), SECOND)

        columns.append(slope(along, SECOND) / b[:, axis, None])
    return size[:, :, None] * np.stack(columns, axis=2)


def _scaled(x: Array, dx: Array) -> tuple[Array, Array]:
    """dx = size u, a size (N,1) a point, so that every point moves by about its own scale max(1, |x|)."""
    size = (np.abs(dx) / np.maximum(1.0, np.abs(x))).max(axis=1, keepdims=True)
    return size, np.divide(dx, size, out=np.zeros_like(dx), where=size > 0)
