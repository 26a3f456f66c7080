"""Gravity  f = m g.  Lecture: "Particle system"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_array
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import few_columns
from dsim.effects.curvature import Change
from dsim.effects.rows import GravityRows

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Gravity:
    """f_i = m_i g; energy -sum m_i g . x_i.  acceleration g: (d,) m/s^2.  Its derivative by mass is g."""

    acceleration: Numbers
    name: str = "gravity"
    parameters = ("mass", "acceleration")
    symmetric = True
    mass: Array | None = None  # (N,), set by bind

    def __post_init__(self) -> None:
        object.__setattr__(self, "acceleration", as_array("acceleration", self.acceleration, (None,)))

    def bind(self, mass: Array, dimension: int) -> Gravity:
        as_array("acceleration", self.acceleration, (dimension,))
        return replace(self, mass=mass)

    def rows(self) -> GravityRows:
        assert self.mass is not None
        return GravityRows(self.mass, self.acceleration)

    def force(self, t: float, q: Array, v: Array) -> Array:
        assert self.mass is not None
        return np.outer(self.mass, self.acceleration).ravel()

    def energy(self, t: float, q: Array) -> float:
        return -float(self.force(t, q, q) @ q)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        assert self.mass is not None
        points, d = len(self.mass), len(self.acceleration)
        point, axis = np.divmod(np.arange(points * d), d)
        values = np.stack([self.acceleration[axis], self.mass[point]], axis=1)
        return few_columns(values, np.stack([point, points + axis], axis=1), points + d)

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[float, float, Array]:
        assert self.mass is not None
        per_point = w.reshape(len(self.mass), -1)
        return 0.0, 0.0, np.concatenate([per_point @ self.acceleration, self.mass @ per_point])

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[float, float, Array]:
        """m and g multiply: each one's gradient changes with the other."""
        assert self.mass is not None
        per_point = w.reshape(len(self.mass), -1)
        dmass, dacceleration = np.split(change[2], [len(self.mass)])
        return 0.0, 0.0, np.concatenate([per_point @ dacceleration, dmass @ per_point])
