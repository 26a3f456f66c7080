"""Effects of points on bodies: a spring between corners, drag on a fin, a thruster.  Lecture: torque = (p - x) x f.

A point p fixed in a body stands at x = c + R p and moves with x' = v + R (omega x p).  A small turn delta of the body
moves it by R (delta x p).  So with J = dx'/dv, the generalized force of point forces f is J^T f = (f, p x R^T f).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, Numbers, as_array
from dsim.arrays.frozen import replace
from dsim.arrays.rotation import cross, normalised, skew, to_matrix
from dsim.effects.bodies import FEW, BodyLayout, Poses
from dsim.effects.rows import has_rows, products

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# attributes that are not the inner effect's: its binding and its derivatives are about points
OWN = ("effect", "markers", "masses", "bind", "bind_bodies", "curvature", "symmetric")
OPTIONAL = (
    "energy",
    "dtheta",
    "at",
    "columns",
)  # capabilities of the inner effect that are passed on where it has them


@dataclass(frozen=True, eq=False)
class Attached:
    """An effect of points, with its points fixed to bodies: point i of `effect` is at[i] in the frame of body to[i].

    to (M,): centres, counted through particles first, then bodies.  at (M,3) m from the centre of mass, 0 for
    particles.  The effect keeps its name and parameters.
    """

    effect: Any
    to: Any  # stored as (M,) indices
    at: Numbers

    def __post_init__(self) -> None:
        at = as_array("at", self.at, (None, 3))
        to = np.asarray(self.to)
        if to.shape != (len(at),) or not np.issubdtype(to.dtype, np.integer):
            raise ValueError(f"to must be whole numbers, one for each of the {len(at)} points; got {self.to!r:.60}")
        if hasattr(self.effect, "bind_bodies"):
            raise ValueError(f"effect must be one of points; {self.effect.name} acts on bodies already")
        if "mass" in getattr(self.effect, "parameters", ()):
            raise ValueError(f"{self.effect.name} acts on masses, so on centres of mass: give it without Attached")
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "to", to.astype(np.int64))

    @property
    def name(self) -> str:
        return str(self.effect.name)

    def force(self, t: float, q: Array, v: Array) -> Array:
        raise ValueError(f"{self.name} is attached to bodies: it needs RigidBodies")

    def bind_bodies(self, layout: BodyLayout) -> AtPoints:
        if self.to.size and (self.to.min() < 0 or self.to.max() >= layout.centres):
            raise ValueError(f"to must be indices from 0 to {layout.centres - 1}; got {self.to.min()}..{self.to.max()}")
        if np.any(self.at[self.to < layout.particles]):
            raise ValueError("at must be 0 for particles: they have no extent")
        return AtPoints(bound(self.effect, np.ones(len(self.to))), Markers(layout, self.to, self.at))


def bound(effect: Any, mass: Array) -> Any:
    """The effect bound to points in space."""
    return effect.bind(mass, 3) if hasattr(effect, "bind") else effect


class Markers:
    """M points on bodies: where they are, how they move, and the force on the bodies that forces on them make."""

    def __init__(self, layout: BodyLayout, to: NDArray[np.int64] | None = None, at: Array | None = None) -> None:
        self.layout = layout
        self.centred = to is None  # every centre, in order
        self.to = np.arange(layout.centres) if to is None else to
        self.at = np.zeros((len(self.to), 3)) if at is None else at
        self.arms = np.flatnonzero(self.at.any(axis=1))  # those off their body's centre
        self.bodies = self.to[self.arms] - layout.particles
        self.offsets = self.at[self.arms]
        self._dofs, self._spins = layout.centre_dofs[self.to].ravel(), layout.spin_dofs[self.bodies]
        self._across = skew(self.offsets)  # [p]x
        self._kept: tuple[bytes, Array, Array] | None = None

    def _frames(self, q: Array) -> tuple[Array, Array]:
        """R and -R [p]x (A,3,3) at the arms, kept for the last q: a step asks many times about the same place."""
        key = q.tobytes()
        if self._kept is None or self._kept[0] != key:
            R = to_matrix(normalised(self.layout.turns(q)[self.bodies]))
            self._kept = key, R, -R @ self._across
        return self._kept[1:]

    def places(self, q: Array) -> Array:
        """x (M,3) m."""
        centres = self.layout.centres_of(q)
        if self.centred:
            return centres
        x = centres[self.to]
        x[self.arms] += _each(self._frames(q)[0], self.offsets)
        return x

    def velocities(self, q: Array, v: Array) -> Array:
        """J v: x' (M,3) m/s, and as well the displacement by a small change of place (n,)."""
        velocities = self.layout.velocities_of(v)
        if self.centred:
            return velocities
        out = velocities[self.to]
        out[self.arms] += _each(self._frames(q)[1], self.layout.spins(v)[self.bodies])
        return out

    def push(self, q: Array, forces: Array) -> Array:
        """J^T f (n,)."""
        if self.centred:
            return self.layout.on_centres(forces)
        out = np.bincount(self._dofs, forces.ravel(), self.layout.n)
        return out + self.twist(_each(self._frames(q)[1].swapaxes(1, 2), forces[self.arms]))

    def local(self, q: Array, forces: Array) -> Array:
        """R^T f (A,3) of the points with an arm."""
        return _each(self._frames(q)[0].swapaxes(1, 2), forces[self.arms])

    def twist(self, torques: Array) -> Array:
        """Torques (A,3) at the arms, in the body frame, as a generalized force (n,)."""
        total: Any = np.bincount(self._spins.ravel(), np.ascontiguousarray(torques).ravel(), self.layout.n)
        return np.asarray(total)

    @property
    def few(self) -> bool:
        """Whether J is an array."""
        return 3 * len(self.to) * self.layout.n <= FEW

    def jacobian(self, q: Array, arms: Array | None = None) -> Any:
        """J (3M,n), CSR unless `few`.  With arms (A,3) in place of the offsets, only what turns move: -R [arm]x."""
        R, turned = self._frames(q)
        if arms is not None:
            turned = -R @ skew(arms)
        if self.few:
            J = np.zeros((3 * len(self.to), self.layout.n))
            if arms is None:
                J[np.arange(len(J)), self._dofs] = 1.0
            lines = 3 * self.arms[:, None, None] + np.arange(3)[:, None]
            J[lines, self._spins[:, None, :]] = turned
            return J
        from scipy.sparse import csr_array

        rows = np.broadcast_to(3 * self.arms[:, None, None] + np.arange(3)[:, None], turned.shape)
        columns = np.broadcast_to(self._spins[:, None, :], turned.shape)
        entries, r, c = turned.ravel(), rows.ravel(), columns.ravel()
        if arms is None:
            entries = np.concatenate([np.ones(len(self._dofs)), entries])
            r, c = np.concatenate([np.arange(len(self._dofs)), r]), np.concatenate([self._dofs, c])
        return csr_array((entries, (r, c)), shape=(3 * len(self.to), self.layout.n))

    def turning(self, q: Array, forces: Array) -> Any:
        """d(J^T f)/dq at fixed f, (n,n): [p]x [R^T f]x at every arm."""
        return self.layout.by_turns(self._spins, self._across @ skew(self.local(q, forces)))


def _each(matrices: Array, vectors: Array) -> Array:
    """Matrix (A,3,3) times vector (A,3), each."""
    return np.asarray(np.einsum("aij,aj->ai", matrices, vectors))


@dataclass(frozen=True, eq=False)
class AtPoints:
    """An effect of points acting through markers; see `Attached`.  On centres alone nothing turns."""

    effect: Any
    markers: Markers
    masses: slice | None = None  # which of the system's masses are the effect's

    @property
    def name(self) -> str:
        return str(self.effect.name)

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(getattr(self.effect, "parameters", ()))

    def __getattr__(self, label: str) -> Any:
        """Parameters of the inner effect, and the capabilities that it has."""
        if label.startswith("__") or label in OWN:
            raise AttributeError(label)
        if label in OPTIONAL and label != "columns":
            if getattr(self.effect, label, None) is None:
                raise AttributeError(label)
            return getattr(self, f"_{label}")
        return getattr(self.effect, label)

    @property
    def rows(self) -> Any:
        """Where the inner effect has rows and acts on the centres of a scene of bodies alone."""
        alone = self.markers.centred and not self.markers.layout.particles
        return (lambda: CentreRows(self.effect.rows())) if alone and has_rows(self.effect) else None

    def rebound(self, mass: Array, layout: BodyLayout) -> AtPoints:
        """The same in another system of bodies."""
        m = self.markers
        if m.centred:
            return AtPoints(bound(self.effect, mass), Markers(layout))
        if m.to.max(initial=-1) >= layout.centres:
            raise ValueError(f"{self.name} is attached to centre {m.to.max()}; there are {layout.centres}")
        return AtPoints(self.effect, Markers(layout, m.to, m.at))

    def exchanged(self, **values: Any) -> AtPoints:
        """With other parameter values."""
        return replace(self, effect=replace(self.effect, **values))

    def _at(self, t: float, q: Array, h: float) -> AtPoints:
        return replace(self, effect=self.effect.at(t, self.markers.places(q).ravel(), h))

    def _place(self, q: Array, v: Array) -> tuple[Array, Array]:
        return self.markers.places(q).ravel(), self.markers.velocities(q, v).ravel()

    def _energy(self, t: float, q: Array) -> float:
        return float(self.effect.energy(t, self.markers.places(q).ravel()))

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self.markers.push(q, self._forces(t, self._place(q, v)))

    def _forces(self, t: float, place: tuple[Array, Array]) -> Array:
        """The inner effect's forces (M,3), checked: a wrong shape would be spread over all points."""
        force = self.effect.force(t, *place)
        self._check("force", force, place[0].shape)
        return np.asarray(force).reshape(-1, 3)

    def _check(self, capability: str, value: Any, shape: tuple[int, ...]) -> None:
        if np.shape(value) != shape:
            raise ValueError(f"{capability} of {self.name!r} must return shape {shape}; got {np.shape(value)}")

    @cached_property
    def _needs(self) -> tuple[bool, bool, bool]:
        """Whether the force changes with the points' places, with their velocities, and with turns of the bodies."""
        dq, dv = (getattr(self.effect, name, None) is not None for name in ("dq", "dv"))
        return dq, dv, bool(self.markers.arms.size)

    @property
    def dq(self) -> Any:
        by_place, _, turns = self._needs
        return self._dq if by_place or turns else None

    @property
    def dv(self) -> Any:
        return self._dv if self._needs[1] else None

    def _points(self, capability: str, place: Any) -> Any:
        """A matrix of the inner effect, as an array where J is one."""
        matrix = getattr(self.effect, capability)(*place)
        self._check(capability, matrix, (place[1].size, place[1].size))
        return matrix.toarray() if self.markers.few and not isinstance(matrix, np.ndarray) else matrix

    def _dq(self, t: float, q: Array, v: Array) -> Any:
        """J^T (Kx J + Dx d(Jv)/dq) + d(J^T f)/dq."""
        m, (x, u), total = self.markers, self._place(q, v), 0
        by_place, by_velocity, turns = self._needs
        J = m.jacobian(q)
        if by_place:
            total = total + J.T @ self._points("dq", (t, x, u)) @ J
        if turns:
            total = total + m.turning(q, self._forces(t, (x, u)))
            if by_velocity:
                arms = cross(m.layout.spins(v)[m.bodies], m.offsets)
                total = total + J.T @ self._points("dv", (t, x, u)) @ m.jacobian(q, arms)
        return total

    def _dv(self, t: float, q: Array, v: Array) -> Any:
        J = self.markers.jacobian(q)
        return J.T @ self._points("dv", (t, *self._place(q, v))) @ J

    def _dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        return csr_array(self.markers.jacobian(q).T @ self.effect.dtheta(t, *self._place(q, v)))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array, Array, Any]:
        """The products of the points' Jacobians with J w, carried back to the bodies."""
        m, (x, u) = self.markers, self._place(q, v)
        pulled = m.velocities(q, w).ravel()
        x_bar, u_bar, theta_bar = products(self.effect, t, (x, u), pulled)
        x_bar, u_bar = (np.broadcast_to(bar, x.shape).reshape(-1, 3) for bar in (x_bar, u_bar))
        by_q, by_v = m.push(q, x_bar), m.push(q, u_bar)
        if m.arms.size:
            spins, turns = m.layout.spins(v)[m.bodies], m.layout.spins(w)[m.bodies]
            swung = cross(cross(spins, m.offsets), m.local(q, u_bar))
            forces = m.local(q, self._forces(t, (x, u)))
            by_q = by_q + m.twist(swung + cross(forces, cross(m.offsets, turns)))
        return by_q, by_v, theta_bar


class CentreRows:
    """Rows of an effect of points on the centres of bodies."""

    def __init__(self, rows: Any) -> None:
        self._rows, self._saved = rows, tuple(np.empty(shape) for shape in rows.saves)
        if (constant := getattr(rows, "constant", None)) is not None:
            self.constant = np.concatenate([constant, np.zeros_like(constant)])

    def add_force(self, t: float, place: Poses, v: Array, out: Array) -> None:
        self._rows.add_force(t, place.poses[:3], v[:3], out[:3], self._saved)
