"""How a stepper turns bodies: the coordinates in which one step of `RigidBodies` is an ordinary step.

A rule adds; attitudes do not.  So a step is taken in coordinates around its start q0, which is their origin:

    "exponential", "cayley"   q = q0 (x) map(xi).  The rule moves xi by velocities, as it moves the positions of points:
                              q1 = q0 (x) map(h v1) for the Euler methods, and for normalising, which is "cayley".
    "lie"                     the same coordinates with their true rate, xi' = dexp^-1 v (Runge-Kutta-Munthe-Kaas)
    "ambient"                 q itself, q' = 1/2 q (x) (0, omega), normalised at the end of the step

A chart offers what `System` offers the rules.  `leave` makes a state of what the rule told; `carry` and `leave_tangent`
are its derivatives, with the change of the start that every coordinate depends on; `*_vjp` are their transposes.
Changes of attitude are small turns in the body frame; those of states are of all 13 numbers a body.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.arrays.scatter import diagonal
from dsim.effects.bodies import BodyLayout
from dsim.rigid import RigidBodies
from dsim.solve.linear import DENSE_SIZE

if TYPE_CHECKING:
    pass

MAPS = ("exponential", "cayley", "lie", "ambient")


def chart_of(system: Any, y0: Array, kind: str) -> Any:
    """The coordinates of one step from y0; the system itself where positions add."""
    if not system.curved:
        return system
    if kind not in MAPS:
        raise ValueError(f"rotation must be one of {', '.join(MAPS)}; got {kind!r}")
    if kind in ("exponential", "cayley"):
        return Chart(system, y0, kind)
    return {"lie": LieChart, "ambient": Ambient}[kind](system, y0)


class _Bodies:
    """What all charts share."""

    curved = True

    def __init__(self, system: RigidBodies, y0: Array) -> None:
        self.system, self.frame = system, system.frame
        self.size, self.parameter_count = system.size, system.parameter_count
        self._given = y0[: system.width]
        self._norms = rotation.norms(system.frame.turns(self._given))  # 1, but for a start that is given otherwise
        self.start = np.array(self._given)
        self.frame.turns(self.start)[:] /= self._norms

        self._matrices: dict[bytes, tuple[Any, Any, Any]] = {}

    def _load(self, t: float, place: tuple[Array, Array], k: Array, change: tuple[Array, Array, Array]) -> Array:
        """The change of f - M k from (small turn, dv, dtheta); the matrices of a place are made once for all."""
        key = b"".join([np.float64(t).tobytes(), *(part.tobytes() for part in (*place, k))])
        if key not in self._matrices:
            partials = self.system.stage_partials(t, *place)
            self._matrices[key] = (*partials, self.system.stage_dtheta(t, place, k))
        by_q, by_v, by_theta = self._matrices[key]
        load: Array = by_q @ change[0] + by_v @ change[1] + by_theta @ change[2]
        return load

    def _unit(self, q: Array) -> Array:
        q = np.array(q)
        turns = self.frame.turns(q)
        turns[:] = rotation.normalised(turns)
        return q

    def _start_turn(self, dq: Array) -> Array:
        """The small turn (n,) of the start, from a change of its numbers."""
        out = self.frame.small_turn(self.start, dq)
        self.frame.spins(out)[:] /= self._norms
        return out

    def _start_turn_vjp(self, bar: Array) -> Array:
        scaled = np.array(bar)
        self.frame.spins(scaled)[:] /= self._norms
        return self.frame.small_turn_vjp(self.start, scaled)

    def stage_band(self, weights: Any) -> None:
        return None

    def stage_energy(self, t: float, weights: Any) -> None:
        return None


class Chart(_Bodies):
    """q = q0 (x) map(xi), moved as positions are: xi (n,) and v (n,)."""

    components = 2

    def __init__(self, system: RigidBodies, y0: Array, kind: str) -> None:
        super().__init__(system, y0)
        self.n = system.n
        self._map = getattr(rotation, kind)
        self._inverse = {"exponential": rotation.logarithm, "cayley": rotation.inverse_cayley}[kind]
        self._tangent = getattr(rotation, f"{kind}_tangent")

    def blocks(self, y: Array) -> tuple[Array, Array]:
        """xi and v of a state."""
        q, v = y[: self.system.width], y[self.system.width :]
        at_start = np.array_equal(q, self._given)
        return np.zeros(self.n) if at_start else self._coordinates(q), self.system.free * v

    def _coordinates(self, q: Array) -> Array:
        frame, out = self.frame, np.zeros(self.n)
        frame.of_particles(out)[:] = frame.of_particles(q) - frame.of_particles(self.start)
        frame.twists(out)[:, :3] = frame.poses(q)[:, :3] - frame.poses(self.start)[:, :3]
        turned = rotation.product(rotation.conjugate(frame.turns(self.start)), rotation.normalised(frame.turns(q)))
        frame.spins(out)[:] = self._inverse(turned)
        return out

    def reached(self, xi: Array) -> Array:
        """q0 (x) map(xi)."""
        frame, q = self.frame, self.start.copy()
        if not xi.any():
            return q
        frame.of_particles(q)[:] += frame.of_particles(xi)
        frame.poses(q)[:, :3] += frame.twists(xi)[:, :3]
        frame.turns(q)[:] = rotation.normalised(rotation.product(frame.turns(self.start), self._map(frame.spins(xi))))
        return q

    def leave(self, parts: Any) -> Array:
        return np.concatenate([self.reached(parts[0]), parts[1]])

    # Changes: of the start, carried along, and of the coordinates

    def enter_tangent(self, dy: Array) -> tuple[Array, tuple[Array, Array]]:
        """(change of the start as small turns, changes of xi and v) of a change of y0."""
        system = self.system
        return self._start_turn(dy[: system.width]), (np.zeros(self.n), system.free * dy[system.width :])

    def enter_vjp(self, start_bar: Array, bars: Any) -> Array:
        return np.concatenate([self._start_turn_vjp(start_bar), self.system.free * bars[1]])

    def coordinates_tangent(self, y: Array, dy: Array, dstart: Array) -> tuple[Array, Array]:
        """Changes of xi and v from those of a state (not the start) and of the start: T^-1 (turn - R(map)^T dstart)."""
        frame, (q, _), width = self.frame, self.blocks(y), self.system.width
        unit = y[:width].copy()
        turned = frame.small_turn(unit, dy[:width])
        frame.spins(turned)[:] /= _squares(frame, unit)
        out = turned - self._carried(q, np.zeros(self.n), dstart)
        frame.spins(out)[:] = np.linalg.solve(self._tangent(frame.spins(q)), frame.spins(out)[..., None])[..., 0]
        return out, self.system.free * dy[width:]

    def carry(self, place: Any, dplace: Any, dstart: Array) -> tuple[Array, Array]:
        """The small turn at a place, from changes of its coordinates and of the start: R(map)^T dstart + T dxi."""
        return self._carried(place[0], dplace[0], dstart), dplace[1]

    def _carried(self, xi: Array, dxi: Array, dstart: Array) -> Array:
        frame, out = self.frame, dxi + dstart
        r = frame.spins(xi)
        back = rotation.rotate(rotation.conjugate(self._map(r)), frame.spins(dstart))
        frame.spins(out)[:] = back + np.einsum("bij,bj->bi", self._tangent(r), frame.spins(dxi))
        return out

    def carry_vjp(self, place: Any, bars: Any) -> tuple[tuple[Array, Array], Array]:
        """((bars of xi and v), bar of the start) from the bars of the small turn and of v."""
        xi_bar, start_bar = self._carried_vjp(place[0], bars[0])
        return (xi_bar, bars[1]), start_bar

    def _carried_vjp(self, xi: Array, bar: Array) -> tuple[Array, Array]:
        frame, xi_bar, start_bar = self.frame, np.array(bar), np.array(bar)
        r = frame.spins(xi)
        frame.spins(start_bar)[:] = rotation.rotate(self._map(r), frame.spins(bar))
        frame.spins(xi_bar)[:] = np.einsum("bij,bi->bj", self._tangent(r), frame.spins(bar))
        return xi_bar, start_bar

    def leave_tangent(self, parts: Any, dparts: Any, dstart: Array) -> Array:
        turned = self._carried(parts[0], dparts[0], dstart)
        return np.concatenate([self.frame.change_of(self.reached(parts[0]), turned), dparts[1]])

    def leave_vjp(self, parts: Any, mu: Array) -> tuple[tuple[Array, Array], Array]:
        width = self.system.width
        bar = self.frame.change_vjp(self.reached(parts[0]), mu[:width])
        xi_bar, start_bar = self._carried_vjp(parts[0], bar)
        return (xi_bar, mu[width:]), start_bar

    # Stages

    def rate(self, t: float, xi: Array, v: Array) -> Array:
        return self.system.rate(t, self.reached(xi), v)

    def stage_residual(self, k: Array, t: float, xi: Array, v: Array) -> Array:
        return self.system.stage_residual(k, t, self.reached(xi), v)

    def stage_matrix(self, t: float, place: Any, weights: tuple[float, float]) -> Any:
        """M - b K T - c D; dense where a dense factorization is quicker."""
        system, q, (b, c) = self.system, self.reached(place[0]), weights
        dense = self.n <= DENSE_SIZE
        total = system.mass_matrix.toarray() if dense else system.mass_matrix
        if b and system.having("dq"):
            K = system.dense("dq", t, q, place[1]) if dense else system.dq(t, q, place[1])
            total = total - b * self._held(K @ self._block(place[0]))
        if c and system.having("dv"):
            D = system.dense("dv", t, q, place[1]) if dense else system.dv(t, q, place[1])
            total = total - c * self._held(D)
        return total

    def _held(self, matrix: Any) -> Any:
        """Pinned rows and columns cleared."""
        free = self.system.free
        if free.all():
            return matrix
        return (
            free[:, None] * matrix * free
            if isinstance(matrix, np.ndarray)
            else diagonal(free) @ matrix @ diagonal(free)
        )

    def _block(self, xi: Array) -> Any:
        """T, block-diagonal (n,n)."""
        frame = self.frame
        blocks, spins = self._tangent(frame.spins(xi)), frame.spin_dofs
        if self.n <= DENSE_SIZE:
            T = np.eye(self.n)
            T[spins[:, :, None], spins[:, None, :]] = blocks
            return T
        from scipy.sparse import csr_array

        rows, columns = (np.broadcast_to(p, blocks.shape).ravel() for p in (spins[:, :, None], spins[:, None, :]))
        ones = frame.centre_dofs.ravel()
        entries = np.concatenate([np.ones(len(ones)), blocks.ravel()])
        place = (np.concatenate([ones, rows]), np.concatenate([ones, columns]))
        return csr_array((entries, place), shape=(self.n, self.n))

    def stage_solve(self, w: Array) -> Array:
        return self.system.stage_solve(w)

    def stage_tangent(self, t: float, place: Any, k: Array, dplace: Any, dtheta: Array) -> Array:
        return self._load(t, (self.reached(place[0]), place[1]), k, (*dplace, dtheta))

    def stage_vjp(self, t: float, place: Any, k: Array, w: Array, theta_bar: Array) -> tuple[Array, Array]:
        return self.system.stage_vjp(t, (self.reached(place[0]), place[1]), k, w, theta_bar)


class _FirstOrder(_Bodies):
    """Coordinates z and velocities as one block (z, v) with the rate (z', M^-1 f): for explicit rules."""

    components = 1

    def __init__(self, system: RigidBodies, y0: Array) -> None:
        super().__init__(system, y0)
        self.n = self._width() + system.n

    def _width(self) -> int:
        raise NotImplementedError

    def _parts(self, y: Array) -> tuple[Array, Array]:
        return y[: self._width()], y[self._width() :]

    def stage_solve(self, w: Array) -> Array:
        return w

    def stage_matrix(self, t: float, place: Any, weights: Any) -> Any:
        raise ValueError("implicit steppers turn bodies by the exponential or the Cayley map")

    stage_residual = stage_matrix


class LieChart(_FirstOrder):
    """xi' = dexp^-1(xi) v, to the fourth order: v + [xi, v]/2 + [xi, [xi, v]]/12 with brackets of turns."""

    def __init__(self, system: RigidBodies, y0: Array) -> None:
        super().__init__(system, y0)
        self._chart = Chart(system, y0, "exponential")

    def _width(self) -> int:
        return self.system.n

    def blocks(self, y: Array) -> tuple[Array]:
        return (np.concatenate(self._chart.blocks(y)),)

    def leave(self, parts: Any) -> Array:
        return self._chart.leave(self._parts(parts[0]))

    def enter_tangent(self, dy: Array) -> tuple[Array, tuple[Array]]:
        dstart, changes = self._chart.enter_tangent(dy)
        return dstart, (np.concatenate(changes),)

    def enter_vjp(self, start_bar: Array, bars: Any) -> Array:
        return self._chart.enter_vjp(start_bar, self._parts(bars[0]))

    def coordinates_tangent(self, y: Array, dy: Array, dstart: Array) -> tuple[Array]:
        return (np.concatenate(self._chart.coordinates_tangent(y, dy, dstart)),)

    def carry(self, place: Any, dplace: Any, dstart: Array) -> Any:
        return (dplace[0], dstart)

    def carry_vjp(self, place: Any, bars: Any) -> Any:
        return (bars[0],), bars[1]

    def leave_tangent(self, parts: Any, dparts: Any, dstart: Array) -> Array:
        return self._chart.leave_tangent(self._parts(parts[0]), self._parts(dparts[0]), dstart)

    def leave_vjp(self, parts: Any, mu: Array) -> Any:
        bars, start_bar = self._chart.leave_vjp(self._parts(parts[0]), mu)
        return (np.concatenate(bars),), start_bar

    def rate(self, t: float, y: Array) -> Array:
        xi, v = self._parts(y)
        return np.concatenate([self._kinematics(xi, v), self._chart.rate(t, xi, v)])

    def _kinematics(self, xi: Array, v: Array) -> Array:
        out, r, w = v.copy(), self.frame.spins(xi), self.frame.spins(v)
        once = rotation.cross(r, w)
        self.frame.spins(out)[:] += once / 2 + rotation.cross(r, once) / 12
        return out

    def stage_tangent(self, t: float, place: Any, k: Array, dplace: Any, dtheta: Array) -> Array:
        (xi, v), (dxi, dv) = self._parts(place[0]), self._parts(dplace[0])
        r, w, dr, dw = (self.frame.spins(a) for a in (xi, v, dxi, dv))
        donce = rotation.cross(dr, w) + rotation.cross(r, dw)
        out = dv.copy()
        self.frame.spins(out)[:] += (
            donce / 2 + (rotation.cross(dr, rotation.cross(r, w)) + rotation.cross(r, donce)) / 12
        )
        moved = self._chart.carry((xi, v), (dxi, dv), dplace[1])
        load = self._chart.stage_tangent(t, (xi, v), self._parts(k)[1], moved, dtheta)
        return np.concatenate([out, self.system.stage_solve(load)])

    def stage_vjp(self, t: float, place: Any, k: Array, w: Array, theta_bar: Array) -> tuple[Array, Array]:
        (xi, v), (by_xi, by_v) = self._parts(place[0]), self._parts(w)
        r, spin, b = (self.frame.spins(a) for a in (xi, v, by_xi))
        cross = rotation.cross
        bars = self._chart.stage_vjp(t, (xi, v), self._parts(k)[1], self.system.stage_solve(by_v), theta_bar)
        (xi_bar, v_bar), start_bar = self._chart.carry_vjp((xi, v), bars)
        once_bar = b / 2 + cross(b, r) / 12  # of r x w
        v_bar = v_bar + by_xi
        self.frame.spins(v_bar)[:] += cross(once_bar, r)
        self.frame.spins(xi_bar)[:] += cross(spin, once_bar) + cross(cross(r, spin), b) / 12
        return np.concatenate([xi_bar, v_bar]), start_bar


class Ambient(_FirstOrder):
    """The numbers of y as they are; forces see the unit quaternion."""

    def _width(self) -> int:
        return self.system.width

    def blocks(self, y: Array) -> tuple[Array]:
        q, v = self._parts(y)
        return (np.concatenate([self._unit(q), self.system.free * v]),)

    def leave(self, parts: Any) -> Array:
        q, v = self._parts(parts[0])
        return np.concatenate([self._unit(q), v])

    def enter_tangent(self, dy: Array) -> tuple[Array, tuple[Array]]:
        q, v = self._parts(dy)
        turned = self.frame.change_of(self.start, self._start_turn(q))
        return np.zeros(0), (np.concatenate([turned, self.system.free * v]),)

    def enter_vjp(self, start_bar: Array, bars: Any) -> Array:
        q, v = self._parts(bars[0])
        turned = self._start_turn_vjp(self.frame.change_vjp(self.start, q))
        return np.concatenate([turned, self.system.free * v])

    def coordinates_tangent(self, y: Array, dy: Array, dstart: Array) -> tuple[Array]:
        return (self.leave_tangent((y,), (dy,), dstart),)

    def carry(self, place: Any, dplace: Any, dstart: Array) -> Any:
        return dplace

    def carry_vjp(self, place: Any, bars: Any) -> Any:
        return bars, np.zeros(0)

    def leave_tangent(self, parts: Any, dparts: Any, dstart: Array) -> Array:
        (q, _), (dq, dv) = self._parts(parts[0]), self._parts(dparts[0])
        out = np.array(dq)
        self.frame.turns(out)[:] = _across(self.frame.turns(q), self.frame.turns(dq))
        return np.concatenate([out, dv])

    def leave_vjp(self, parts: Any, mu: Array) -> Any:
        return (self.leave_tangent(parts, (mu,), np.zeros(0)),), np.zeros(0)  # the projection is symmetric

    def rate(self, t: float, y: Array) -> Array:
        q, v = self._parts(y)
        out = np.empty(self.n)
        change, acceleration = self._parts(out)
        change[:] = self.frame.change_of(q, v)
        acceleration[:] = self.system.rate(t, self._unit(q), v)
        return out

    def stage_tangent(self, t: float, place: Any, k: Array, dplace: Any, dtheta: Array) -> Array:
        frame, (q, v), (dq, dv) = self.frame, self._parts(place[0]), self._parts(dplace[0])
        out = frame.change_of(q, dv)
        frame.turns(out)[:] += frame.turns(frame.change_of(dq, v))  # q (x) omega is linear in q
        moved = self._small_turn(q, dq), dv
        load = self._load(t, (self._unit(q), v), self._parts(k)[1], (*moved, dtheta))
        return np.concatenate([out, self.system.stage_solve(load)])

    def _small_turn(self, q: Array, dq: Array) -> Array:
        out = self.frame.small_turn(q, dq)
        self.frame.spins(out)[:] /= _squares(self.frame, q)
        return out

    def stage_vjp(self, t: float, place: Any, k: Array, w: Array, theta_bar: Array) -> tuple[Array]:
        frame, (q, v), (q_bar, by_v) = self.frame, self._parts(place[0]), self._parts(w)
        solved = self.system.stage_solve(by_v)
        turn_bar, v_bar = self.system.stage_vjp(t, (self._unit(q), v), self._parts(k)[1], solved, theta_bar)
        turn_bar = np.array(turn_bar)
        frame.spins(turn_bar)[:] /= _squares(frame, q)
        out = frame.small_turn_vjp(q, turn_bar)
        # 1/2 q (x) (0, omega) is transposed by the conjugate; centres do not depend on where they are
        frame.turns(out)[:] -= frame.turns(frame.change_of(q_bar, v))
        return (np.concatenate([out, v_bar + frame.change_vjp(q, q_bar)]),)


def _squares(frame: BodyLayout, q: Array) -> Array:
    turns = frame.turns(q)
    return np.asarray(np.einsum("bi,bi->b", turns, turns)[:, None])


def _across(q: Array, dq: Array) -> Array:
    """The change of q/|q|: (dq - q (q.dq)/|q|^2) / |q|."""
    square = np.einsum("bi,bi->b", q, q)[:, None]
    along = np.einsum("bi,bi->b", q, dq)[:, None]
    return np.asarray((dq - q * along / square) / np.sqrt(square))
