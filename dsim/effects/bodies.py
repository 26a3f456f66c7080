"""Where the coordinates of particles and rigid bodies lie, and generalized forces on them.

    q = [x of N particles; x and unit quaternion of B bodies]       (3N + 7B,)
    v = [velocities of the particles; velocity in the world and angular velocity in the body of B bodies]  (3N + 6B,)

Force Jacobians of bodies are by small turns in the body frame, so that K and D are both (n,n): q becomes
q (x) exp(delta).  An effect for bodies has `bind_bodies(layout) -> Effect`; any other effect acts on centres of mass.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.arrays.rotation import conjugate, product

FEW = 20_000  # numbers up to which matrices are arrays


class Poses(Protocol):
    """A place, on component rows."""

    @property
    def poses(self) -> Array:
        """(7,B)."""
        ...


class BodyRows(Protocol):
    """A bound effect of bodies on component rows, which an explicit run evaluates in place; `rows()` makes one."""

    # `constant` (6,B), where an effect has it, is its force at any time and state: `add_force` is not called then

    def add_force(self, t: float, place: Poses, v: Array, out: Array) -> None:
        """out (6,B) += force; v (6,B)."""
        ...


@dataclass(frozen=True)
class BodyLayout:
    """N particles, then B bodies; their centres count through, particles first."""

    particles: int
    bodies: int
    first: int = 0  # of the bodies that turns and spins are about, in an effect of a part of the scene
    count: int | None = None

    def part(self, first: int, count: int) -> BodyLayout:
        """The same coordinates, with the turns and spins of some bodies alone."""
        return replace(self, first=first, count=count)

    @property
    def chosen(self) -> slice:
        return slice(self.first, self.bodies if self.count is None else self.first + self.count)

    @property
    def turning(self) -> int:
        """How many bodies turns and spins are about."""
        return self.bodies if self.count is None else self.count

    @property
    def centres(self) -> int:
        return self.particles + self.bodies

    @property
    def width(self) -> int:
        """Length of q."""
        return 3 * self.particles + 7 * self.bodies

    @property
    def n(self) -> int:
        """Length of v."""
        return 3 * self.particles + 6 * self.bodies

    def of_particles(self, q: Array) -> Array:
        """Positions or velocities (N,3) of the particles, a view of q or v."""
        return q[: 3 * self.particles].reshape(self.particles, 3)

    def poses(self, q: Array) -> Array:
        """(B,7), a view of q."""
        return q[3 * self.particles :].reshape(self.bodies, 7)

    def twists(self, v: Array) -> Array:
        """(B,6), a view of v, or of a force: (force in the world, torque in the body)."""
        return v[3 * self.particles :].reshape(self.bodies, 6)

    def turns(self, q: Array) -> Array:
        """Quaternions (B,4), a view."""
        return self.poses(q)[self.chosen, 3:]

    def spins(self, v: Array) -> Array:
        """Angular velocities, or torques, (B,3), a view."""
        return self.twists(v)[self.chosen, 3:]

    def centres_of(self, q: Array) -> Array:
        """Positions (N+B,3)."""
        return self._points(self.of_particles(q), self.poses(q))

    def velocities_of(self, v: Array) -> Array:
        """Velocities (N+B,3) of the centres."""
        return self._points(self.of_particles(v), self.twists(v))

    def _points(self, particles: Array, bodies: Array) -> Array:
        return bodies[:, :3] if not self.particles else np.concatenate([particles, bodies[:, :3]])

    def on_centres(self, forces: Array) -> Array:
        """Forces (N+B,3) on the centres as a generalized force (n,)."""
        out = np.zeros(self.n)
        self.of_particles(out)[:] = forces[: self.particles]
        self.twists(out)[:, :3] = forces[self.particles :]
        return out

    @cached_property
    def centre_dofs(self) -> NDArray[np.int64]:
        """(N+B,3): the places in v of each centre's velocity."""
        starts = np.concatenate([3 * np.arange(self.particles), 3 * self.particles + 6 * np.arange(self.bodies)])
        return np.asarray(starts[:, None] + np.arange(3))

    @cached_property
    def spin_dofs(self) -> NDArray[np.int64]:
        """(B,3): the places in v of each angular velocity."""
        return np.asarray(3 * self.particles + 6 * np.arange(self.bodies)[self.chosen, None] + np.arange(3, 6))

    def by_turns(self, places: NDArray[np.int64], blocks: Array) -> Any:
        """Blocks (K,3,3) at places (K,3) of v, on the diagonal of a matrix (n,n), summed where places are the same.

        An array where n is small, else CSR: below some thousand numbers a sparse matrix costs more than its sums.
        """
        rows, columns = places[:, :, None], places[:, None, :]
        if self.n**2 <= FEW:
            total = np.zeros((self.n, self.n))
            np.add.at(total, (rows, columns), blocks)
            return total
        from scipy.sparse import csr_array

        where = tuple(np.broadcast_to(place, blocks.shape).ravel() for place in (rows, columns))
        return csr_array((blocks.ravel(), where), shape=(self.n, self.n))

    def small_turn(self, q: Array, dq: Array) -> Array:
        """The change (n,) of place that dq (width,) is: turns in the body frame, 2 vec(q* (x) dq), for any |q|."""
        out = np.empty(self.n)
        self.of_particles(out)[:] = self.of_particles(dq)
        self.twists(out)[:, :3] = self.poses(dq)[:, :3]
        self.spins(out)[:] = 2 * product(conjugate(self.turns(q)), self.turns(dq))[:, 1:]
        return out

    def change_of(self, q: Array, turn: Array) -> Array:
        """dq (width,) of a change of place (n,): 1/2 q (x) (0, delta) for the quaternions."""
        out = np.empty(self.width)
        self.of_particles(out)[:] = self.of_particles(turn)
        self.poses(out)[:, :3] = self.twists(turn)[:, :3]
        self.turns(out)[:] = product(self.turns(q), _pure(0.5 * self.spins(turn)))
        return out

    def small_turn_vjp(self, q: Array, bar: Array) -> Array:
        """The transpose of `small_turn`: (n,) -> (width,), without a part along q."""
        out = self.change_of(q, bar)
        self.turns(out)[:] *= 4.0
        return out

    def change_vjp(self, q: Array, bar: Array) -> Array:
        """The transpose of `change_of`: (width,) -> (n,)."""
        out = self.small_turn(q, bar)
        self.spins(out)[:] *= 0.25
        return out


def _pure(u: Array) -> Array:
    """(0, u)."""
    out = np.zeros((len(u), 4))
    out[:, 1:] = u
    return out
