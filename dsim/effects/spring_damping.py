"""Damping along springs  f_ij = -k_d (v_ij . x_ij_hat) x_ij_hat.  Lecture: "Mass-spring systems"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_pairs, check_indices
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import ElementScatter
from dsim.effects.curvature import Change
from dsim.effects.springs import per_element
from dsim.kernels.spring import both_ends, both_pairs, directions, turning

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class SpringDamping:
    """Resists the rate of change of length of each pair.  pairs (E,2), coefficient k_d (E,) kg/s.

    With the edge e = x_j - x_i, n = e/l and u = v_j - v_i, the force on j is -k_d s n, s = u.n.  Its
    derivatives are -k_d n n^T by u and -k_d [ n u^T P + s P ] / l by e, P = I - n n^T, which is not
    symmetric.  Coincident ends have no direction and feel no damping.
    """

    pairs: Numbers
    coefficient: Numbers
    name: str = "spring_damping"
    parameters = ("coefficient",)
    symmetric = False
    scatter: ElementScatter | None = field(default=None, repr=False)  # set by bind

    def __post_init__(self) -> None:
        pairs = as_pairs("pairs", self.pairs)
        object.__setattr__(self, "pairs", pairs)
        object.__setattr__(self, "coefficient", per_element("coefficient", self.coefficient, len(pairs)))

    def bind(self, mass: Array, dimension: int) -> SpringDamping:
        check_indices("pairs", self.pairs, len(mass))
        return replace(self, scatter=ElementScatter(self.pairs, len(mass), dimension))

    def _edges(self, q: Array, v: Array) -> tuple[ElementScatter, Array, Array, Array]:
        """The scatter, lengths (E,), directions (E,d), relative velocities (E,d)."""
        assert self.scatter is not None
        x, velocity = self.scatter.gather(q), self.scatter.gather(v)
        length, n = directions(x[:, 1] - x[:, 0])
        return self.scatter, length, n, velocity[:, 1] - velocity[:, 0]

    def force(self, t: float, q: Array, v: Array) -> Array:
        scatter, _, n, u = self._edges(q, v)
        rate = np.einsum("ed,ed->e", u, n)
        return -scatter.vector(both_ends((self.coefficient * rate)[:, None] * n))

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        scatter, length, n, u = self._edges(q, v)
        rate = np.einsum("ed,ed->e", u, n)
        flat = np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        turned = n[:, :, None] * np.einsum("ed,edj->ej", u, flat)[:, None, :]
        block = inverse(length, self.coefficient)[:, None, None] * (turned + rate[:, None, None] * flat)
        return scatter.matrix(-both_pairs(block))

    def dv(self, t: float, q: Array, v: Array) -> csr_array:
        scatter, _, n, _ = self._edges(q, v)
        return scatter.matrix(-both_pairs(self.coefficient[:, None, None] * n[:, :, None] * n[:, None, :]))

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        scatter, _, n, u = self._edges(q, v)
        rate = np.einsum("ed,ed->e", u, n)
        return -scatter.mixed(both_ends((rate[:, None] * n)[:, :, None]))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array, Array, Array]:
        scatter, length, n, u = self._edges(q, v)
        ends = scatter.gather(w)
        z = ends[:, 1] - ends[:, 0]
        rate, along = np.einsum("ed,ed->e", u, n), np.einsum("ed,ed->e", z, n)
        across = along[:, None] * (u - rate[:, None] * n) + rate[:, None] * (z - along[:, None] * n)
        by_q = -scatter.vector(both_ends(inverse(length, self.coefficient)[:, None] * across))
        by_v = -scatter.vector(both_ends((self.coefficient * along)[:, None] * n))
        return by_q, by_v, -rate * along

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[Array, Array, Array]:
        """The product rule on `vjp`:  -k_d/l [ a (u - s n) + s (z - a n) ] by e,  -k_d a n by u,  -s a by k_d, with
        s = u.n, a = z.n,  dl and dn as in `turning`, ds = du.n + u.dn, da = z.dn."""
        scatter, length, n, u = self._edges(q, v)
        de, du, z = (scatter.edges(values) for values in (change[0], change[1], w))
        dl, dn = turning(scatter.edges(q), de)
        k, dk = self.coefficient, change[2]
        s, a, da = (np.einsum("ed,ed->e", *pair)[:, None] for pair in ((u, n), (z, n), (z, dn)))
        ds = np.einsum("ed,ed->e", du, n)[:, None] + np.einsum("ed,ed->e", u, dn)[:, None]
        across = a * (u - s * n) + s * (z - a * n)
        dacross = da * (u - s * n) + a * (du - ds * n - s * dn) + ds * (z - a * n) - s * (da * n + a * dn)
        ratio = inverse(length, k)
        dratio = inverse(length, dk - ratio * dl)
        by_q = -scatter.edge_vector(dratio[:, None] * across + ratio[:, None] * dacross)
        by_v = -scatter.edge_vector(dk[:, None] * a * n + k[:, None] * (da * n + a * dn))
        return by_q, by_v, -(ds * a + s * da).ravel()


def inverse(length: Array, scale: Array) -> Array:
    """scale / l, and 0 where the ends coincide."""
    ratio: Array = np.divide(scale, length, out=np.zeros_like(length), where=length > 0)
    return ratio
