"""Drag and wind  f = -c (v - v_air).  Lecture: "Particle system"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_answer, as_array, as_nonnegative
from dsim.arrays.differences import change_of_jacobian, change_of_slopes
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import block_diagonal, diagonal, few_columns, pointwise_jacobian
from dsim.effects.curvature import Change
from dsim.effects.rows import DragRows

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Wind = Callable[[float, Array], Any]


@dataclass(frozen=True, eq=False)
class Drag:
    """f_i = -c_i (v_i - wind(t, x_i)).

    coefficient: c, a number or (N,), kg/s.  wind: None for still air, (d,) m/s, or a callable
    (t, x (N,d)) -> (N,d) in which point i depends on x_i alone.  wind_jacobian: its derivative
    (t, x) -> (N,d,d); without one it is differenced (nine to ten digits), and `differenced` says so.
    """

    coefficient: Numbers
    wind: Numbers | Wind | None = None
    wind_jacobian: Wind | None = None
    name: str = "drag"
    points: int = 0  # set by bind
    dimension: int = 0

    def __post_init__(self) -> None:
        coefficient = as_nonnegative("coefficient", self.coefficient)
        if coefficient.ndim > 1:
            raise ValueError(f"coefficient must be a number or (N,); got shape {coefficient.shape}")
        object.__setattr__(self, "coefficient", coefficient)
        if self.wind is not None and not callable(self.wind):
            object.__setattr__(self, "wind", as_array("wind", self.wind, (None,)))
        if self.wind_jacobian is not None and not callable(self.wind_jacobian):
            raise ValueError(
                f"wind_jacobian must be a callable (t, x), for a callable wind; got {self.wind_jacobian!r:.60}"
            )
        if self.wind_jacobian is not None and not callable(self.wind):
            given = None if self.wind is None else np.asarray(self.wind).tolist()
            raise ValueError(
                f"wind_jacobian must go with a callable wind (t, x): leave it out, or give one; got wind {given!r:.60}"
            )

    @property
    def differenced(self) -> bool:
        """True when the wind's derivative in place comes from finite differences."""
        return callable(self.wind) and self.wind_jacobian is None

    @property
    def symmetric(self) -> bool:
        return not callable(self.wind)

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("coefficient", "wind") if isinstance(self.wind, np.ndarray) else ("coefficient",)

    def bind(self, mass: Array, dimension: int) -> Drag:
        if self.coefficient.ndim:
            as_array("coefficient", self.coefficient, (len(mass),))
        if isinstance(self.wind, np.ndarray):
            as_array("wind", self.wind, (dimension,))
        return replace(self, points=len(mass), dimension=dimension)

    @property
    def rows(self) -> Callable[[], DragRows] | None:
        """In-place rows where the wind is the same everywhere."""
        wind: Any = self.wind
        return None if callable(wind) else lambda: DragRows(self.coefficient, wind)

    def _slip(self, t: float, q: Array, v: Array) -> Array:
        """v - v_air, (N,d)."""
        velocity = v.reshape(self.points, self.dimension)
        if self.wind is None:
            return velocity
        if not callable(self.wind):
            return velocity - self.wind
        return velocity - self._air(t, q.reshape(velocity.shape))

    def _air(self, t: float, x: Array) -> Array:
        """What a callable wind returns at x (N,d): (N,d), or (d,) where it is the same everywhere."""
        assert callable(self.wind)
        return as_answer("wind", self.wind(t, x), x.shape, (self.dimension,))

    def _per_dof(self) -> Array:
        """The coefficient of every degree of freedom, (n,)."""
        return np.repeat(np.broadcast_to(self.coefficient, self.points), self.dimension)

    def force(self, t: float, q: Array, v: Array) -> Array:
        return -self._per_dof() * self._slip(t, q, v).ravel()

    @property
    def dq(self) -> Callable[[float, Array, Array], csr_array] | None:
        """c dwind/dx; structurally zero unless the wind depends on place."""
        return self._dq if callable(self.wind) else None

    def _wind_blocks(self, t: float, q: Array) -> Array:
        x = q.reshape(self.points, self.dimension)
        if self.wind_jacobian is None:
            return pointwise_jacobian(lambda place: np.broadcast_to(self._air(t, place), x.shape), x)
        return as_array("wind_jacobian", self.wind_jacobian(t, x), (self.points, self.dimension, self.dimension))

    def _dq(self, t: float, q: Array, v: Array) -> csr_array:
        c = np.broadcast_to(self.coefficient, self.points)
        return block_diagonal(c[:, None, None] * self._wind_blocks(t, q))

    def dv(self, t: float, q: Array, v: Array) -> csr_array:
        return diagonal(-self._per_dof())

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        point, axis = np.divmod(np.arange(self.points * self.dimension), self.dimension)
        values, count = [-self._slip(t, q, v).ravel()], self.coefficient.size
        columns = [point if self.coefficient.ndim else np.zeros_like(point)]
        if isinstance(self.wind, np.ndarray):
            values.append(self._per_dof())
            columns.append(count + axis)
            count += self.dimension
        return few_columns(np.stack(values, axis=1), np.stack(columns, axis=1), count)

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array | float, Array, Array]:
        c = self._per_dof()
        by_q: Array | float = 0.0
        if callable(self.wind):
            per_point = (c * w).reshape(self.points, self.dimension)
            by_q = np.einsum("nij,ni->nj", self._wind_blocks(t, q), per_point).ravel()
        by_point = -np.einsum("nd,nd->n", self._slip(t, q, v), w.reshape(self.points, -1))
        theta = [by_point if self.coefficient.ndim else np.array([by_point.sum()])]
        if isinstance(self.wind, np.ndarray):
            theta.append((c * w).reshape(self.points, -1).sum(axis=0))
        return by_q, -c * w, np.concatenate(theta)

    @property
    def curvature_differenced(self) -> bool:
        """True for a callable wind: its second derivative is a difference of the first, or of the wind itself."""
        return callable(self.wind)

    def _turned_wind(self, t: float, x: Array, dx: Array) -> Array:
        """The change of dwind/dx along dx, (N,d,d): ten digits from a wind_jacobian, nine without one."""
        if self.wind_jacobian is None:
            return change_of_slopes(lambda place: np.broadcast_to(self._air(t, place), x.shape), x, dx)
        return change_of_jacobian(lambda place: self._wind_blocks(t, place), x, dx)

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[Array | float, Array, Array]:
        """c dJ^T w + dc J^T w by x_i,  -dc w by v_i,  -(dv - J dx).w by c_i,  sum dc w by the wind;  J = dwind/dx."""
        x, dx, dslip, push = (a.reshape(self.points, self.dimension) for a in (q, change[0], change[1], w))
        count = self.coefficient.size
        c, dc = (np.broadcast_to(a.reshape(-1, 1), (self.points, 1)) for a in (self.coefficient, change[2][:count]))
        by_q: Array | float = 0.0
        if callable(self.wind):
            slopes, turned = self._wind_blocks(t, q), self._turned_wind(t, x, dx)
            by_q = np.einsum("nij,ni->nj", c[:, :, None] * turned + dc[:, :, None] * slopes, push).ravel()
            dslip = dslip - np.einsum("nij,nj->ni", slopes, dx)
        elif self.wind is not None:
            dslip = dslip - change[2][count:]
        by_point = -np.einsum("nd,nd->n", dslip, push)
        theta = [by_point if self.coefficient.ndim else np.array([by_point.sum()])]
        if isinstance(self.wind, np.ndarray):
            theta.append((dc * push).sum(axis=0))
        return by_q, (-dc * push).ravel(), np.concatenate(theta)
