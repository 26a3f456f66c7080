"""Outlines for pictures: a shape is a list of plane faces, corners (K,3) m in the frame of the body."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array, as_positive


def box_faces(sides: Any, at: Any = (0.0, 0.0, 0.0)) -> list[Array]:
    """Six faces; sides (3,) m, whole edges, about the point `at`.  The last two are those across z, the upper first."""
    half, at = 0.5 * as_positive("sides", sides, (3,)), as_array("at", at, (3,))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return [at + half * np.insert(corners, axis, sign, axis=1) for axis in range(3) for sign in (1.0, -1.0)]


def racket_faces(length: float = 0.68, width: float = 0.26) -> list[Array]:
    """A tennis racket along x: the upper and the lower side of its head, a flat plate, then the handle's, at -x."""
    angle = 2 * np.pi * np.arange(24) / 24
    head = np.stack([0.28 * length * np.cos(angle), 0.5 * width * np.sin(angle), 0 * angle], axis=1)
    sides = [head + np.array([0.22 * length, 0.0, z]) for z in (0.005, -0.005)]
    return sides + box_faces([0.44 * length, 0.04, 0.03], [-0.28 * length, 0.0, 0.0])
