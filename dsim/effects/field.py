"""A spatial force field  f = f(x).  Lecture: "Particle system"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from dsim.arrays.checks import Array, as_answer
from dsim.arrays.differences import change_of_jacobian, change_of_slopes
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import block_diagonal, pointwise_jacobian
from dsim.effects.curvature import Change

if TYPE_CHECKING:
    from scipy.sparse import csr_array

PointMap = Callable[[Array], Any]


@dataclass(frozen=True, eq=False)
class Field:
    """f_i = force(x)_i, which depends on x_i alone.

    force: callable x (N,d) m -> (N,d) N.  jacobian: its derivative -> (N,d,d) N/m; without one it is
    differenced (nine to ten digits), and `differenced` says so.  potential: optional x -> (N,) J with
    force = -grad potential, which lets the energy be reported and descended.
    """

    function: PointMap
    jacobian: PointMap | None = None
    potential: PointMap | None = None
    name: str = "field"
    points: int = 0  # set by bind
    dimension: int = 0
    symmetric = False  # a general field is no gradient

    def __init__(
        self,
        force: PointMap,
        jacobian: PointMap | None = None,
        potential: PointMap | None = None,
        name: str = "field",
    ) -> None:
        for label, value in (("force", force), ("jacobian", jacobian), ("potential", potential)):
            if not callable(value) and (value is not None or label == "force"):
                raise ValueError(f"{label} must be a callable of x (N,d); got {value!r:.60}")
        given = {"function": force, "jacobian": jacobian, "potential": potential, "name": name}
        for label, attribute in given.items():
            object.__setattr__(self, label, attribute)

    @property
    def differenced(self) -> bool:
        """True when the derivative comes from finite differences."""
        return self.jacobian is None

    def bind(self, mass: Array, dimension: int) -> Field:
        return replace(self, points=len(mass), dimension=dimension)

    def _values(self, label: str, function: PointMap, q: Array, shape: tuple[int, ...]) -> Array:
        return as_answer(f"{self.name}.{label}", function(q.reshape(self.points, self.dimension)), shape)

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self._values("force", self.function, q, (self.points, self.dimension)).ravel()

    @property
    def energy(self) -> Callable[[float, Array], float] | None:
        """The potential's sum, when a potential was given."""
        return None if self.potential is None else self._energy

    def _energy(self, t: float, q: Array) -> float:
        return float(self._values("potential", cast(PointMap, self.potential), q, (self.points,)).sum())

    def _blocks(self, q: Array) -> Array:
        shape = (self.points, self.dimension, self.dimension)
        if self.jacobian is None:
            return pointwise_jacobian(
                lambda x: self._values("force", self.function, x, shape[:2]), q.reshape(shape[:2])
            )
        return self._values("jacobian", self.jacobian, q, shape)

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        return block_diagonal(self._blocks(q))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array, float, float]:
        by_q = np.einsum("nij,ni->nj", self._blocks(q), w.reshape(self.points, self.dimension))
        return by_q.ravel(), 0.0, 0.0

    curvature_differenced = True

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[Array, float, float]:
        """dJ^T w, by differences of the jacobian to about ten digits; of the force, where it has none, to nine."""
        x, dx, push = (a.reshape(self.points, self.dimension) for a in (q, change[0], w))
        if self.jacobian is None:
            turned = change_of_slopes(lambda z: self._values("force", self.function, z, x.shape), x, dx)
        else:
            turned = change_of_jacobian(self._blocks, x, dx)
        return np.einsum("nij,ni->nj", turned, push).ravel(), 0.0, 0.0
