"""Gravity  f = m g.  Lecture: "Particle system"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_array
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import block_columns
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
        from scipy.sparse import csr_array, hstack

        assert self.mass is not None
        points, d = len(self.mass), len(self.acceleration)
        by_mass = block_columns(np.broadcast_to(self.acceleration, (points, d)))
        by_acceleration = csr_array(np.kron(self.mass[:, None], np.eye(d)))
        return csr_array(hstack([by_mass, by_acceleration]))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[float, float, Array]:
        assert self.mass is not None
        per_point = w.reshape(len(self.mass), -1)
        return 0.0, 0.0, np.concatenate([per_point @ self.acceleration, self.mass @ per_point])
