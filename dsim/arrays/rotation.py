"""Rotations: quaternions (...,4) as w, x, y, z, rotation vectors (...,3) in rad, matrices (...,3,3).  Lecture: "Rigid
bodies".

A quaternion q turns vectors of the body into vectors of the world; its product with another turns first by the right
factor.  q and -q are the same attitude.  Angular velocity is meant in the body frame unless a name says otherwise.
All functions work on any leading axes; those that say "unit" take q as it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array

SMALL = 1e-4  # rad^2: below, series; their next terms are under the round-off of 1
TINY = 1e-150  # rad: sin(TINY)/TINY is 1, and no product of it underflows


def as_unit(name: str, value: Any, shape: tuple[int | None, ...] = (4,)) -> Array:
    """Quaternions of this shape, divided by their norms; ValueError for one that is zero, or not finite."""
    q = as_array(name, value, shape)
    if not (largest := np.abs(q).max(axis=-1)).all():
        where = np.argwhere(largest == 0)[0].tolist()
        place = f" at index {where[0] if len(where) == 1 else tuple(where)}" if where else ""
        raise ValueError(f"{name} must be quaternions other than 0, which is no attitude; got (0, 0, 0, 0){place}")
    return normalised(q)


def normalised(q: Array) -> Array:
    """q / |q|, also of numbers whose squares are too large or too small."""
    q = np.asarray(q)
    square = np.einsum("...i,...i->...", q, q)
    if 1e-200 < square.min(initial=1.0) and square.max(initial=1.0) < 1e200:
        return np.asarray(q / np.sqrt(square)[..., None])
    return np.asarray(q / norms(q))


def norms(q: Array) -> Array:
    """|q| (...,1), of numbers of any size."""
    largest = np.abs(q).max(axis=-1, keepdims=True)
    scale = np.where(largest > 0, largest, 1.0)
    return np.asarray(scale * np.sqrt(np.einsum("...i,...i->...", q / scale, q / scale))[..., None])


def conjugate(q: Array) -> Array:
    """The inverse of a unit quaternion."""
    return q * [1.0, -1.0, -1.0, -1.0]


def _room(a: Array, b: Array) -> Array:
    """Room for a result, laid out as a is: where components are contiguous rows (3,B).T they stay so."""
    shape = a.shape if a.shape == b.shape else np.broadcast_shapes(a.shape, b.shape)
    return np.empty_like(a, dtype=float, shape=shape)


def cross(a: Array, b: Array) -> Array:
    """a x b along the last axis; several times as quick as numpy.cross."""
    a, b = np.asarray(a), np.asarray(b)
    out = _room(a, b)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=out[..., i])
    return out


def skew(w: Array) -> Array:
    """[w]x (...,3,3), with [w]x u = w x u: the matrix of the notes' Rdot = [omega]x R."""
    out = np.zeros((*w.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., k, j], out[..., j, k] = w[..., i], -w[..., i]
    return out


def product(p: Array, q: Array) -> Array:
    """p (x) q: turns by q first, then by p."""
    p, q = np.asarray(p), np.asarray(q)
    out = _room(p, q)
    pw, px, py, pz = (p[..., i] for i in range(4))
    qw, qx, qy, qz = (q[..., i] for i in range(4))
    np.multiply(p, qw[..., None], out=out)
    w, x, y, z = (out[..., i] for i in range(4))
    w -= px * qx
    w -= py * qy
    w -= pz * qz
    x += pw * qx
    x += py * qz
    x -= pz * qy
    y += pw * qy
    y += pz * qx
    y -= px * qz
    z += pw * qz
    z += px * qy
    z -= py * qx
    return out


def rotate(q: Array, u: Array) -> Array:
    """R(q) u of a unit quaternion: body to world."""
    q = np.asarray(q)
    twice = 2 * cross(q[..., 1:], u)
    turned: Array = u + q[..., :1] * twice + cross(q[..., 1:], twice)
    return turned


def to_matrix(q: Array) -> Array:
    """R(q) (...,3,3) of a unit quaternion."""
    q = np.asarray(q)
    w, x, y, z = (q[..., i] for i in range(4))
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = (
        1 - 2 * (y * y + z * z),
        1 - 2 * (x * x + z * z),
        1 - 2 * (x * x + y * y),
    )
    out[..., 0, 1], out[..., 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    out[..., 0, 2], out[..., 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    out[..., 1, 2], out[..., 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return out


def from_matrix(R: Array) -> Array:
    """The unit quaternion with w >= 0 of a rotation matrix (...,3,3), through its largest component (Shepperd 1978)."""
    d0, d1, d2 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    a, b, c = R[..., 2, 1], R[..., 0, 2], R[..., 1, 0]
    e, f, g = R[..., 1, 2], R[..., 2, 0], R[..., 0, 1]
    rows = np.stack([  # row i is 4 q_i q
        np.stack([1 + d0 + d1 + d2, a - e, b - f, c - g], axis=-1),
        np.stack([a - e, 1 + d0 - d1 - d2, c + g, b + f], axis=-1),
        np.stack([b - f, c + g, 1 - d0 + d1 - d2, a + e], axis=-1),
        np.stack([c - g, b + f, a + e, 1 - d0 - d1 + d2], axis=-1),
    ], axis=-2)  # fmt: skip
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = normalised(np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., :1] < 0, -q, q)


def exponential(r: Array) -> Array:
    """The turn by |r| rad about r: (cos |r|/2, sin(|r|/2) r/|r|)."""
    r = np.asarray(r)
    half = np.maximum(0.5 * np.sqrt(np.einsum("...i,...i->...", r, r)), TINY)
    out = np.empty_like(r, dtype=float, shape=(*r.shape[:-1], 4))
    np.cos(half, out=out[..., 0])
    np.multiply((np.sin(half) / (2 * half))[..., None], r, out=out[..., 1:])
    return out


def logarithm(q: Array) -> Array:
    """The shortest rotation vector of a quaternion, |r| <= pi; any norm but 0.  atan2 keeps tiny turns and half turns.

    The inverse of `exponential` up to full turns: q and -q give the same.  Raises ValueError for a quaternion 0.
    """
    q = np.asarray(q)
    if not q.any(axis=-1).all():
        as_unit("q", q, q.shape)
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.sqrt(np.einsum("...i,...i->...", q[..., 1:], q[..., 1:]))
    half = np.arctan2(sine, q[..., 0])
    ratio = np.where(sine > 0, 0.0, 2.0 / np.where(sine > 0, 1.0, q[..., 0]))
    np.divide(2 * half, sine, out=ratio, where=sine > 0)
    vector: Array = ratio[..., None] * q[..., 1:]
    return vector


def cayley(r: Array) -> Array:
    """(1, r/2) / |(1, r/2)|: the turn by 2 atan(|r|/2) about r.

    What normalising q + qdot h makes of a step: the notes' loop turns by this map.
    """
    out = np.empty_like(r, dtype=float, shape=(*r.shape[:-1], 4))
    scale = 1 / np.sqrt(1 + 0.25 * np.einsum("...i,...i->...", r, r))
    out[..., 0] = scale
    np.multiply((0.5 * scale)[..., None], r, out=out[..., 1:])
    return out


def inverse_cayley(q: Array) -> Array:
    """r with cayley(r) = +-q; not finite for half turns."""
    vector: Array = 2 * q[..., 1:] / q[..., :1]
    return vector


def body_rates(q: Array) -> Array:
    """E (...,4,3) with qdot = 1/2 E omega = 1/2 q (x) (0, omega), omega in the body frame; E^T E = |q|^2."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def world_rates(q: Array) -> Array:
    """G (...,4,3) with qdot = 1/2 G omega = 1/2 (0, omega) (x) q, omega in the world frame.

    The matrix of the notes, whose first entry lost its minus sign there: only with -q_x is q . G omega = 0, so that
    the norm stays.
    """
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def exponential_tangent(r: Array) -> Array:
    """T (...,3,3): exp(r + dr) = exp(r) (x) exp(T dr) to first order, the right Jacobian.

    T = 1 - (1 - cos a)/a^2 [r]x + (a - sin a)/a^3 [r]x^2, a = |r|.
    """
    square = np.einsum("...i,...i->...", r, r)
    small, angle = square < SMALL, np.sqrt(square)
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - square / 24 + square**2 / 720, 2 * (np.sin(safe / 2) / safe) ** 2)
    second = np.where(small, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)
    return _polynomial(r, -first, second)


def cayley_tangent(r: Array) -> Array:
    """T (...,3,3): cayley(r + dr) = cayley(r) (x) exp(T dr) to first order; T = (1 - [r]x/2) / (1 + |r|^2/4)."""
    scale = 1 / (1 + 0.25 * np.einsum("...i,...i->...", r, r))
    return np.asarray(scale[..., None, None] * (np.eye(3) - 0.5 * skew(r)))


def _polynomial(r: Array, first: Array, second: Array) -> Array:
    """1 + first [r]x + second [r]x^2, with [r]x^2 = r r^T - |r|^2."""
    outer = r[..., :, None] * r[..., None, :]
    square = np.einsum("...ii->...", outer)
    diagonal = (1 - second * square)[..., None, None] * np.eye(3)
    return np.asarray(diagonal + first[..., None, None] * skew(r) + second[..., None, None] * outer)
