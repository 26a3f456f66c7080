"""Forces on coordinate rows, in place: what an explicit run evaluates again and again.

Arrays are (d,N), one contiguous row a coordinate, instead of the (N,d) of the public interface; results are added
into the caller's array; every buffer is made once.  An effect that offers `rows()` returns one of
these; any other is wrapped in `PlainRows`.  A test holds each against the plain `force` and `vjp`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.effects.effect import current


class Rows(Protocol):
    """A bound effect on coordinate rows."""

    saves: tuple[tuple[int, ...], ...]  # shapes of what `add_force` leaves for `add_vjp`
    # `constant` (d,N), where an effect has it, is its force at any time and state: `add_force` is not called then

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        """out (d,N) += force.  `saved` arrays are filled."""
        ...

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        """bars = (x_bar (d,N), v_bar (d,N), one array a parameter): each += its part of w^T d force."""
        ...


class GravityRows:
    """m g: a constant."""

    saves: tuple[tuple[int, ...], ...] = ()

    def __init__(self, mass: Array, acceleration: Array) -> None:
        self.mass, self.acceleration = mass, acceleration
        self.constant = np.outer(acceleration, mass)

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        out += self.constant

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        _, _, mass, acceleration = bars
        mass += self.acceleration @ w
        acceleration += w @ self.mass


class DragRows:
    """-c (v - wind) with still air or a wind that is the same everywhere."""

    saves: tuple[tuple[int, ...], ...] = ()

    def __init__(self, coefficient: Array, wind: Array | None) -> None:
        self.coefficient = coefficient
        self.wind = None if wind is None else wind[:, None]
        self.push = np.empty(0)  # scratch (d,N)

    def _slip(self, v: Array) -> Array:
        return v if self.wind is None else v - self.wind

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        if self.push.shape != v.shape:
            self.push = np.empty(v.shape)
        np.multiply(self.coefficient, self._slip(v), out=self.push)
        out -= self.push

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        _, v_bar, coefficient, *wind = bars
        push = self.coefficient * w
        v_bar -= push
        by_point = self._slip(place[1]) * w
        coefficient -= by_point.sum(axis=0) if coefficient.ndim else by_point.sum()
        if wind:
            wind[0] += push.sum(axis=1)


class SpringRows:
    """Springs.  The edge vectors e and 1/l are saved, so the way back has neither a root nor a division.

    With s = l0/l and u = w_j - w_i: push = k [ (1 - s) u + s (e.u) e / l^2 ]; the gradient by the rest
    length is k (e.u)/l, by the stiffness -(1 - s) (e.u).
    """

    def __init__(self, pairs: NDArray[np.int64], rest: Array, stiffness: Array, shape: tuple[int, int]) -> None:
        d, _ = shape
        self.rest, self.stiffness, self.preload = rest, stiffness, stiffness * rest
        self.behind, self.ahead = (np.ascontiguousarray(column) for column in pairs.T)
        self.to_ends = _sparse_ends(pairs, shape) if len(pairs) > FEW else _counted_ends(pairs, shape)
        self.saves = ((d, len(pairs)), (len(pairs),))
        self.work, self.other, self.scale = np.empty(self.saves[0]), np.empty(self.saves[0]), np.empty(len(pairs))

    def _edges(self, rows: Array, out: Array) -> None:
        """Row values at the end of every edge minus those at its beginning."""
        rows.take(self.ahead, 1, out, "clip")  # "clip" spares the bounds check that "raise" buffers for
        rows.take(self.behind, 1, self.other, "clip")
        np.subtract(out, self.other, out=out)

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        edge, inverse = saved
        self._edges(x, edge)
        np.einsum("de,de->e", edge, edge, out=inverse)
        np.sqrt(inverse, out=inverse)
        np.divide(1.0, inverse, out=inverse)
        if inverse.max(initial=0.0) == np.inf:  # coincident ends have no direction
            inverse[inverse == np.inf] = 0.0
        np.multiply(self.preload, inverse, out=self.scale)
        np.subtract(self.stiffness, self.scale, out=self.scale)  # k (1 - l0/l)
        np.multiply(edge, self.scale, out=self.work)
        out += self.to_ends(self.work)

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        (edge, inverse), (x_bar, _, rest, stiffness) = saved, bars
        u, scale = self.work, self.scale
        self._edges(w, u)
        dot = np.einsum("de,de->e", edge, u)  # e.u
        slack = self.rest * inverse
        along = self.stiffness * dot
        along *= inverse
        rest += along
        along *= slack
        along *= inverse  # k s (e.u) / l^2
        np.subtract(1.0, slack, out=scale)
        dot *= scale
        stiffness -= dot
        scale *= self.stiffness
        np.multiply(u, scale, out=u)
        np.multiply(edge, along, out=self.other)
        np.add(u, self.other, out=u)
        x_bar += self.to_ends(u)


FEW = 1200  # edges up to which a scatter without SciPy is as quick; its import would cost a quarter of a second

Scatter = Callable[[Array], Array]  # (d,E) -> (d,N): plus where an edge begins, minus where it ends


def _sparse_ends(pairs: NDArray[np.int64], shape: tuple[int, int]) -> Scatter:
    """By a sparse matrix (d N, d E) of +1 and -1; int32 indices halve the traffic."""
    from scipy.sparse import csr_array

    d, points = shape
    ones, columns, row = np.ones(d * len(pairs)), np.arange(d * len(pairs)), np.arange(d)[:, None] * points
    places = (np.concatenate([(row + end).ravel() for end in pairs.T]), np.concatenate([columns, columns]))
    matrix = csr_array((np.concatenate([ones, -ones]), places), shape=(d * points, len(columns)))
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    return lambda values: np.asarray(matrix @ values.reshape(-1)).reshape(shape)


def _counted_ends(pairs: NDArray[np.int64], shape: tuple[int, int]) -> Scatter:
    """By weighted counts."""
    d, points = shape
    places = np.concatenate([(np.arange(d)[:, None] * points + end).ravel() for end in pairs.T])

    def scatter(values: Array) -> Array:
        flat = values.reshape(-1)
        weights = np.concatenate([flat, -flat])
        total: Any = np.bincount(places, weights, minlength=d * points)
        return np.asarray(total.reshape(shape))

    return scatter


class PlainRows:
    """Any effect, through its public `force` and a system of its own for the products."""

    saves: tuple[tuple[int, ...], ...] = ()

    def __init__(self, effect: Any) -> None:
        self.effect = effect

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        force = np.asarray(self.effect.force(t, x.T.ravel(), v.T.ravel()))
        if np.shape(force) != (out.size,):
            name = self.effect.name
            raise ValueError(f"force of {name!r} must return shape {(out.size,)}; got {np.shape(force)}")
        out += force.reshape(out.shape[::-1]).T

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        q, v = (rows.T.ravel() for rows in place)
        x_bar, v_bar, *parameters = bars
        by_q, by_v, theta = products(self.effect, t, (q, v), w.T.ravel())
        for bar, value in ((x_bar, by_q), (v_bar, by_v)):
            if isinstance(value, np.ndarray):
                bar += value.reshape(bar.shape[::-1]).T
        start = 0
        for bar in parameters:
            if isinstance(theta, np.ndarray):
                bar += theta[start : start + bar.size].reshape(bar.shape)
            start += bar.size


def rows_of(effect: Any) -> Rows:
    """The effect's own rows, or `PlainRows`.

    Rows stand for the force and the vjp they were written with: a subclass that overrides either loses them.
    """
    if not has_rows(effect):
        return PlainRows(effect)
    rows: Rows = effect.rows()
    return rows


def has_rows(effect: Any) -> bool:
    """Whether the effect has rows of its own."""
    return getattr(effect, "rows", None) is not None and current(effect, "rows", ("force", "vjp"))


def products(effect: Any, t: float, place: tuple[Array, Array], w: Array) -> tuple[Any, Any, Any]:
    """(dq^T w, dv^T w, dtheta^T w) of an effect: by its `vjp`, else by the matrices it has; 0 for a missing one."""
    if getattr(effect, "vjp", None) is not None and current(effect, "vjp", ("force", "dq", "dv", "dtheta")):
        found: tuple[Any, Any, Any] = effect.vjp(t, *place, w)
        return found
    parts = [getattr(effect, capability, None) for capability in ("dq", "dv", "dtheta")]
    by_q, by_v, theta = (0.0 if part is None else part(t, *place).T @ w for part in parts)
    return by_q, by_v, theta
