"""Springs  U = k/2 (|x_ij| - l0)^2.  Lecture: "Mass-spring systems"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_nonnegative, as_pairs, check_indices
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import ElementScatter
from dsim.effects.curvature import Change
from dsim.effects.rows import SpringRows
from dsim.kernels.spring import SPRING, directions, edge_hessian, slackness, tension, turning

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Springs:
    """The force of E springs, f = -dU/dx.  pairs (E,2), rest_length (E,) m, stiffness (E,) N/m (numbers broadcast)."""

    pairs: Numbers
    rest_length: Numbers
    stiffness: Numbers
    name: str = "springs"
    parameters = ("rest_length", "stiffness")
    symmetric = True
    scatter: ElementScatter | None = field(default=None, repr=False)  # set by bind

    def __post_init__(self) -> None:
        pairs = as_pairs("pairs", self.pairs)
        object.__setattr__(self, "pairs", pairs)
        for label in self.parameters:
            object.__setattr__(self, label, per_element(label, getattr(self, label), len(pairs)))

    def bind(self, mass: Array, dimension: int) -> Springs:
        check_indices("pairs", self.pairs, len(mass))
        return replace(self, scatter=ElementScatter(self.pairs, len(mass), dimension))

    def rows(self) -> SpringRows:
        assert self.scatter is not None
        return SpringRows(self.pairs, self.rest_length, self.stiffness, (self.scatter.dimension, self.scatter.count))

    def _elements(self, q: Array) -> tuple[ElementScatter, Array, Array]:
        assert self.scatter is not None
        return self.scatter, self.scatter.gather(q), np.stack([self.rest_length, self.stiffness], axis=1)

    def _edges(self, q: Array) -> tuple[ElementScatter, Array, Array]:
        assert self.scatter is not None
        return self.scatter, self.scatter.edges(q), np.stack([self.rest_length, self.stiffness])

    def force(self, t: float, q: Array, v: Array) -> Array:
        scatter, edge, theta = self._edges(q)
        return -scatter.edge_vector(tension(edge, theta))

    def energy(self, t: float, q: Array) -> float:
        _, x, theta = self._elements(q)
        return float(SPRING.energy(x, theta).sum())

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        scatter, edge, theta = self._edges(q)
        return scatter.edge_matrix(-edge_hessian(edge, theta))

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        scatter, x, theta = self._elements(q)
        return -scatter.mixed(SPRING.mixed(x, theta))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array, float, Array]:
        """Per spring: H u = k [ (1 - l0/l) u + l0/l n (n.u) ] with u = w_j - w_i, no matrix."""
        scatter, edge, _ = self._edges(q)
        length, n = directions(edge)
        u = scatter.edges(w)
        along = np.einsum("ed,ed->e", n, u)
        slack = slackness(length, self.rest_length)
        push = (self.stiffness * (1 - slack))[:, None] * u + (self.stiffness * slack * along)[:, None] * n
        theta = np.concatenate([self.stiffness * along, -(length - self.rest_length) * along])
        return -scatter.edge_vector(push), 0.0, theta

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[Array, float, Array]:
        """The third derivative of the energy and its like, per spring.  With s = l0/l, a = n.u, da = dn.u, and
        ds = (dl0 - s dl)/l:  d(H u) = dk [ (1 - s) u + s a n ] + k [ -ds u + (ds a + s da) n + s a dn ]."""
        scatter, edge, _ = self._edges(q)
        length, n = directions(edge)
        dl, dn = turning(edge, scatter.edges(change[0]))
        u, k = scatter.edges(w), self.stiffness
        drest, dk = np.split(change[2], 2)
        along, dalong = np.einsum("ed,ed->e", n, u), np.einsum("ed,ed->e", dn, u)
        slack = slackness(length, self.rest_length)
        dslack = slackness(length, drest - slack * dl)
        by_u, by_n = dk * (1 - slack) - k * dslack, dk * slack * along + k * (dslack * along + slack * dalong)
        push = by_u[:, None] * u + by_n[:, None] * n + (k * slack * along)[:, None] * dn
        by_stiffness = (drest - dl) * along - (length - self.rest_length) * dalong
        return -scatter.edge_vector(push), 0.0, np.concatenate([dk * along + k * dalong, by_stiffness])


def per_element(label: str, value: Array, count: int) -> Array:
    """A number or (E,) -> (E,), each >= 0; the message names the spring."""
    array = as_nonnegative(label, value)
    if array.ndim and array.shape != (count,):
        raise ValueError(f"{label} must be a number or have shape ({count},), one a pair; got {array.shape}")
    array = np.array(np.broadcast_to(array, count))
    array.setflags(write=False)
    return array
