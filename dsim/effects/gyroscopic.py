"""The torque that makes things tumble, -omega x I omega.  Lecture: "Rigid bodies"."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.arrays.rotation import cross, skew
from dsim.effects.bodies import BodyLayout, Poses

if TYPE_CHECKING:
    from scipy.sparse import csr_array

ENTRIES = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # the six numbers of an inertia: xx, yy, zz, yz, xz, xy


def tensors(six: Array) -> Array:
    """(B,6) -> (B,3,3)."""
    out = np.empty((len(six), 3, 3))
    for place, (i, j) in enumerate(ENTRIES):
        out[:, i, j] = out[:, j, i] = six[:, place]
    return out


def angular_momentum(six: Array, w: Array) -> Array:
    """I omega (B,3)."""
    xx, yy, zz, yz, xz, xy = (six[:, i] for i in range(6))
    x, y, z = (w[:, i] for i in range(3))
    out = np.empty(w.shape)
    out[:, 0] = xx * x + xy * y + xz * z
    out[:, 1] = xy * x + yy * y + yz * z
    out[:, 2] = xz * x + yz * y + zz * z
    return out


class InertiaRows:
    """I omega on component rows; products only with those of the six numbers that are not 0 for all bodies."""

    def __init__(self, six: Array) -> None:
        self._diagonal = six[:, :3].T.copy()
        self._others = [(i, j, six[:, p].copy()) for p, (i, j) in enumerate(ENTRIES) if i != j and six[:, p].any()]

    def times(self, w: Array) -> Array:
        """(3,B) -> (3,B)."""
        out = self._diagonal * w
        for i, j, entry in self._others:
            out[i] += entry * w[j]
            out[j] += entry * w[i]
        return out


class GyroscopicRows:
    """The torque on component rows, of the bodies it acts on."""

    def __init__(self, inertia: Array, acting: Any) -> None:
        self._inertia, self._acting = InertiaRows(inertia[acting]), acting

    def add_force(self, t: float, place: Poses, v: Array, out: Array) -> None:
        w = v[3:][:, self._acting]
        out[3:][:, self._acting] += cross(self._inertia.times(w).T, w.T).T


def by_inertia(w: Array) -> Array:
    """d(I omega)/d(xx, yy, zz, yz, xz, xy), (B,3,6)."""
    out = np.zeros((len(w), 3, 6))
    for place, (i, j) in enumerate(ENTRIES):
        out[:, i, place] = w[:, j]
        out[:, j, place] = w[:, i]
    return out


@dataclass(frozen=True, eq=False)
class Gyroscopic:
    """tau = -omega x I omega, in the body frame.  It does no work.  `RigidBodies` adds it for the bodies whose inertia
    is not a multiple of the identity: for the others it is 0.

    inertia (B,6).  acting: indices of the bodies on which it is evaluated.  Derivatives by the inertia are those of all
    bodies: a sphere's torque is 0, but not its derivative.
    """

    inertia: Array
    layout: BodyLayout
    acting: Any = field(default_factory=lambda: slice(None))  # indices, or a slice
    name: str = "gyroscopic"
    parameters = ("inertia",)

    def force(self, t: float, q: Array, v: Array) -> Array:
        out = np.zeros(self.layout.n)
        w = self.layout.spins(v)[self.acting]
        self.layout.spins(out)[self.acting] = cross(angular_momentum(self.inertia[self.acting], w), w)
        return out

    def rows(self) -> GyroscopicRows:
        return GyroscopicRows(self.inertia, self.acting)

    def dv(self, t: float, q: Array, v: Array) -> Any:
        """[I omega]x - [omega]x I."""
        w = self.layout.spins(v)
        blocks = skew(angular_momentum(self.inertia, w)) - skew(w) @ tensors(self.inertia)
        return self.layout.by_turns(self.layout.spin_dofs[self.acting], blocks[self.acting])

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        w = self.layout.spins(v)
        blocks, places = -skew(w) @ by_inertia(w), self.layout.spin_dofs
        rows = np.broadcast_to(places[:, :, None], blocks.shape)
        columns = np.broadcast_to(6 * np.arange(len(w))[:, None, None] + np.arange(6), blocks.shape)
        return csr_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(self.layout.n, 6 * len(w)))

    def vjp(self, t: float, q: Array, v: Array, u: Array) -> tuple[float, Array, Array]:
        """With b the bar of the torque: by omega, I (omega x b) - (I omega) x b; by I, (omega x b) omega^T."""
        w, b, by_v = self.layout.spins(v), self.layout.spins(u), np.zeros(self.layout.n)
        turned = cross(w, b)
        inertia, kept = self.inertia[self.acting], self.acting
        moment = angular_momentum(inertia, w[kept])
        self.layout.spins(by_v)[kept] = angular_momentum(inertia, turned[kept]) - cross(moment, b[kept])
        return 0.0, by_v, np.einsum("bi,bip->bp", turned, by_inertia(w)).ravel()
