"""Rigid bodies, and particles beside them, as a System whose kinematics is a quaternion.  Lecture: "Rigid bodies".

    x' = v,  q' = 1/2 q (x) (0, omega),  m v' = f,  I omega' = tau - omega x I omega

omega, tau and I are in the frame of the body, so that M = diag(m, m, m, I) is constant.  Everything else - forces and
their derivatives, stages, parameters - is `System`'s: an inertia is six more parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_array, as_positive
from dsim.arrays.frozen import replace
from dsim.arrays.rotation import as_unit, cross, normalised, rotate
from dsim.effects.at_points import AtPoints, Markers, bound
from dsim.effects.bodies import BodyLayout
from dsim.effects.gyroscopic import ENTRIES, Gyroscopic, angular_momentum, by_inertia, tensors
from dsim.system import System, as_effects, as_fixed, fresh, layout_of

if TYPE_CHECKING:
    from scipy.sparse import csr_array

OWN_TORQUE = "gyroscopic"


class RigidBodies(System):
    """B bodies of mass m and inertia I, in 3-D, and perhaps particles beside them (`compose`).

    mass (B,) kg > 0.  inertia (B,3,3) kg m^2 about the centre of mass, in the frame of the body: symmetric, positive
    definite, and no principal moment above the sum of the others.  effects: those for bodies (`Attached`,
    `AngularDrag`, `TorqueActuation`), and effects of points, which act on the centres of mass.  particles (N,) kg, and
    fixed, those of them that are pinned.  The gyroscopic torque is there of itself where it is not 0.

    A state is y = [q, v], see `dsim.effects.bodies`; `state` makes one.  theta names "mass" (N+B,), particles first,
    and "inertia" (B,6): xx, yy, zz, yz, xz, xy.  Raises ValueError on bad input.
    """

    curved = True  # steppers turn by a rotation map
    OF_MASS: ClassVar[tuple[str, ...]] = ("mass_matrix", "_solver")

    def __init__(
        self, mass: Numbers, inertia: Numbers, effects: Any = (), particles: Numbers = (), fixed: Any = ()
    ) -> None:
        bodies = as_positive("mass", mass, (None,))
        six = as_inertia(inertia, len(bodies))
        points = as_positive("particles", particles, (None,))
        if not len(bodies):
            raise ValueError("mass must have at least one body; got shape (0,)")
        frame = BodyLayout(len(points), len(bodies))
        free = np.ones(frame.n)
        if not len(points) and np.size(fixed):
            raise ValueError(f"fixed must be empty: bodies cannot be pinned, but tied by Attached springs; got {fixed}")
        pins = as_fixed(fixed, len(points))
        free[frame.centre_dofs[list(pins)].ravel()] = 0.0
        given = as_effects(effects)
        if any(effect.name == OWN_TORQUE for effect in given):
            raise ValueError(f"an effect may not be called {OWN_TORQUE!r}: RigidBodies has that torque of itself")
        mass = np.concatenate([points, bodies])
        mass.setflags(write=False)
        values = {"mass": mass, "inertia": six, "dimension": 3, "fixed": pins, "free": free,
                  "frame": frame, "patterns": {}}  # fmt: skip
        for name, value in values.items():
            object.__setattr__(self, name, value)
        effects = tuple(_on_bodies(effect, self.mass, frame) for effect in given)
        object.__setattr__(self, "effects", (*effects, *self._torque()))
        object.__setattr__(self, "layout", layout_of(self.own, self.effects))

    frame: BodyLayout
    inertia: Array  # (B,6)
    torque = True  # False after `without("gyroscopic")`: the torque then stays out, whatever the inertia
    composed = False  # made by `compose`

    @property
    def n(self) -> int:
        return self.frame.n

    @property
    def width(self) -> int:
        return self.frame.width

    @property
    def masses(self) -> Array:
        raise AttributeError("bodies have no mass a degree of freedom; see mass_matrix")

    @property
    def own(self) -> dict[str, slice]:
        count = len(self.mass)
        return {"mass": slice(0, count), "inertia": slice(count, count + self.inertia.size)}

    def state(self, position: Any, attitude: Any = None, velocity: Any = 0.0, spin: Any = 0.0) -> Array:
        """y (13B,) of the bodies alone.  position (B,3) m, attitude (B,4) quaternions of any norm, (1,0,0,0) without
        one; velocity (B,3) m/s, spin (B,3) rad/s in the body frame; one row serves all bodies."""
        if self.frame.particles:
            raise ValueError("state is for bodies alone; a scene with particles has compose_states(systems, states)")
        rows = {}
        for name, value, size in (("position", position, 3), ("velocity", velocity, 3), ("spin", spin, 3),
                                  ("attitude", [1.0, 0, 0, 0] if attitude is None else attitude, 4)):  # fmt: skip
            array, whole = as_array(name, value), (self.frame.bodies, size)
            at_rest = array.ndim == 0 and array == 0 and name in ("velocity", "spin")
            if not at_rest and array.shape not in (whole, (size,)):
                raise ValueError(f"{name} must have shape {whole}, or ({size},) for all bodies; got {array.shape}")
            rows[name] = np.array(np.broadcast_to(array, whole))
        rows["attitude"] = as_unit("attitude", rows["attitude"], (None, 4))
        q = np.concatenate([rows["position"], rows["attitude"]], axis=1)
        return np.concatenate([q.ravel(), np.concatenate([rows["velocity"], rows["spin"]], axis=1).ravel()])

    def check_start(self, y0: Array) -> None:
        """Raises ValueError for a quaternion that is 0."""
        as_unit("the attitudes of y0", self.frame.turns(y0[: self.width]), (None, 4))

    def flow(self, t: float, y: Array) -> Array:
        """dy/dt = (v, 1/2 q (x) (0, omega), M^-1 f), for attitudes of any norm."""
        q, v = self.blocks(y)
        return np.concatenate([self.frame.change_of(q, v), self.rate(t, self.unit(q), v)])

    def unit(self, q: Array) -> Array:
        """q with attitudes of norm 1, as forces and energies are meant to see it."""
        unit = q.copy()
        turns = self.frame.turns(unit)
        turns[:] = normalised(turns)
        return unit

    def energy(self, t: float, y: Array) -> float:
        q, v = self.blocks(y)
        return self.kinetic(v) + self.potential(t, self.unit(q))

    def slope_by_turn(self, y: Array, slope: Array) -> Array:
        return np.concatenate([self.frame.change_vjp(y[: self.width], slope[: self.width]), slope[self.width :]])

    def slope_by_state(self, y: Array, slope: Array) -> Array:
        return np.concatenate([self.frame.small_turn_vjp(y[: self.width], slope[: self.n]), slope[self.n :]])

    def turned(self, v: Array, p: Array) -> Array:
        """-omega x p: a small turn in the body frame changes by d(delta)/dt = d(omega) - omega x delta."""
        out = np.zeros_like(p)
        self.frame.spins(out)[:] = cross(self.frame.spins(p), self.frame.spins(v))
        return out

    # Parameters and effects

    def _torque(self) -> tuple[Gyroscopic, ...]:
        """The gyroscopic torque of the bodies that have one."""
        if not self.torque:
            return ()
        six = self.inertia
        round_ = (six[:, 0] == six[:, 1]) & (six[:, 1] == six[:, 2]) & ~six[:, 3:].any(axis=1)
        if round_.all():
            return ()
        acting = np.flatnonzero(~round_) if round_.any() else slice(None)
        return (Gyroscopic(six, self.frame, acting),)

    def with_theta(self, theta: Array) -> RigidBodies:
        twin: Any = super().with_theta(theta)
        kept = tuple(effect for effect in twin.effects if effect.name != OWN_TORQUE)
        effects = (*kept, *twin._torque())
        return replace(twin, effects=effects, layout=layout_of(self.own, effects))

    def without(self, *names: str) -> RigidBodies:
        known = [effect.name for effect in self.effects]
        for name in names:
            if name not in known:
                raise ValueError(f"no effect is called {name!r}; this system has {', '.join(known) or 'none'}")
        kept = tuple(effect for effect in self.effects if effect.name not in names)
        torque = self.torque and OWN_TORQUE not in names
        return fresh(self, effects=kept, layout=layout_of(self.own, kept), torque=torque)

    def _round_torque(self) -> Gyroscopic | None:
        """Where the torque is left out, for it is 0: its derivative by the inertia is not."""
        there = any(effect.name == OWN_TORQUE for effect in self.effects)
        return None if there or not self.torque else Gyroscopic(self.inertia, self.frame)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array, hstack

        total = super().dtheta(t, q, v)
        if (torque := self._round_torque()) is None:
            return total
        place = self.own["inertia"]
        before, after = csr_array((self.n, place.start)), csr_array((self.n, self.parameter_count - place.stop))
        return csr_array(total + hstack([before, torque.dtheta(t, q, v), after]))

    def vjp(self, t: float, q: Array, v: Array, w: Array, theta_bar: Array) -> tuple[Array, Array]:
        if (torque := self._round_torque()) is not None:
            theta_bar[self.own["inertia"]] += torque.vjp(t, q, v, w)[2]
        return super().vjp(t, q, v, w, theta_bar)

    def stage_tangent(
        self, t: float, place: tuple[Array, Array], k: Array, dplace: tuple[Array, Array], dtheta: Array
    ) -> Array:
        total = super().stage_tangent(t, place, k, dplace, dtheta)
        if (torque := self._round_torque()) is not None:
            total += (self.free * (torque.dtheta(t, *place) @ dtheta[self.own["inertia"]]).T).T
        return total

    def relative_change(self, dtheta: Array) -> float:
        """The largest change of a mass or an inertia, relative to it (to its smallest moment)."""
        mass, inertia = (dtheta[self.own[name]] for name in ("mass", "inertia"))
        smallest = np.repeat(np.linalg.eigvalsh(tensors(self.inertia))[:, 0], 6)
        return float(max(np.abs(mass / self.mass).max(), np.abs(inertia / smallest).max()))

    # M = diag(m, I)

    @cached_property
    def mass_matrix(self) -> csr_array:
        return self._block_diagonal(self.mass, tensors(self.inertia))

    def _block_diagonal(self, lights: Array, blocks: Array) -> csr_array:
        """A number for each centre and a block (3,3) for each body, CSR (n,n)."""
        from scipy.sparse import csr_array

        places, spins = self.frame.centre_dofs, self.frame.spin_dofs
        rows, columns = (np.broadcast_to(p, (len(spins), 3, 3)).ravel() for p in (spins[:, :, None], spins[:, None, :]))
        entries = np.concatenate([np.repeat(lights, 3), blocks.ravel()])
        diagonal = places.ravel()
        place = (np.concatenate([diagonal, rows]), np.concatenate([diagonal, columns]))
        return csr_array((entries, place), shape=(self.n, self.n))

    @cached_property
    def _solver(self) -> tuple[Array, Array]:
        """1/m of centres (N+B,1), and the six numbers of each inverse inertia."""
        matrices = tensors(self.inertia)
        try:
            inverse = np.linalg.inv(matrices)
        except np.linalg.LinAlgError as error:
            body = int(np.argmin(np.abs(np.linalg.det(matrices))))
            raise ValueError(f"inertia of body {body} has no inverse; got {matrices[body].tolist()}") from error
        six = np.stack([inverse[:, i, j] for i, j in ENTRIES], axis=1)
        return np.asarray(1 / self.mass[:, None]), six

    @property
    def inverse_inertia(self) -> Array:
        """The six numbers (B,6) of each inverse inertia."""
        return self._solver[1]

    def inverse_root(self) -> csr_array:
        from scipy.sparse import csr_array

        roots = np.linalg.inv(np.linalg.cholesky(tensors(self.inertia))).swapaxes(1, 2)
        return csr_array(self._block_diagonal(1 / np.sqrt(self.mass), roots))

    def momentum(self, v: Array) -> Array:
        frame, out = self.frame, np.empty(self.n)
        frame.of_particles(out)[:] = self.mass[: frame.particles, None] * frame.of_particles(v)
        frame.twists(out)[:, :3] = self.mass[frame.particles :, None] * frame.twists(v)[:, :3]
        frame.spins(out)[:] = angular_momentum(self.inertia, frame.spins(v))
        return out

    def stage_solve(self, w: Array) -> Array:
        frame, (light, six) = self.frame, self._solver
        if w.ndim > 1:
            return np.stack([self.stage_solve(column) for column in w.T], axis=1)
        out = np.empty(self.n)
        frame.of_particles(out)[:] = light[: frame.particles] * frame.of_particles(w)
        frame.twists(out)[:, :3] = light[frame.particles :] * frame.twists(w)[:, :3]
        frame.spins(out)[:] = angular_momentum(six, frame.spins(w))
        return out

    def angular_momentum(self, y: Array) -> Array:
        """Of the whole scene about the world's origin, (3,) kg m^2/s: sum m x x v + R I omega."""
        (q, v), frame = self.blocks(y), self.frame
        own = rotate(normalised(frame.turns(q)), frame.spins(self.momentum(v)))
        orbital = cross(frame.centres_of(q), self.mass[:, None] * frame.velocities_of(v))
        return np.asarray(own.sum(axis=0) + orbital.sum(axis=0))

    def momentum_dtheta(self, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        frame, places, spins = self.frame, self.frame.centre_dofs, self.frame.spin_dofs
        blocks = by_inertia(frame.spins(v))
        first = self.own["inertia"].start
        rows = np.concatenate([places.ravel(), np.broadcast_to(spins[:, :, None], blocks.shape).ravel()])
        inertia = first + 6 * np.arange(frame.bodies)[:, None, None] + np.arange(6)
        masses = np.repeat(np.arange(len(self.mass)), 3)
        columns = np.concatenate([masses, np.broadcast_to(inertia, blocks.shape).ravel()])
        entries = np.concatenate([frame.velocities_of(v).ravel(), blocks.ravel()])
        return csr_array((entries, (rows, columns)), shape=(self.n, self.parameter_count))

    def momentum_tangent(self, v: Array, dtheta: Array) -> Array:
        change: Array = self.momentum_dtheta(v) @ dtheta
        return change

    def curvature(self, *given: Any) -> Any:
        raise ValueError("forces on bodies have no second derivatives in closed form; use hessian_product")

    def momentum_vjp(self, v: Array, w: Array, theta_bar: Array) -> None:
        frame, own = self.frame, self.own
        theta_bar[own["mass"]] += (frame.velocities_of(v) * frame.velocities_of(w)).sum(axis=1)
        by_six = np.einsum("bi,bip->bp", frame.spins(w), by_inertia(frame.spins(v)))
        theta_bar[own["inertia"]] += by_six.ravel()

    def stage_energy(self, t: float, weights: tuple[float, float]) -> None:
        """None: turned forces are no gradient by the rate."""
        return None

    def stage_band(self, weights: tuple[float, float]) -> None:
        return None


def compose(*systems: System, effects: Any = ()) -> RigidBodies:
    """One scene of several: cloths and bodies, each with its effects, tied by further effects.

    Particles of all systems come first, in their order, then the bodies; so do centres in `effects`, and the parts of
    a state (`compose_states`).  Raises ValueError where nothing is a body, a system is not in 3-D, or is composed
    already, or effects share a name.
    """
    _check_parts(systems)
    points = [0 if isinstance(system, RigidBodies) else len(system.mass) for system in systems]
    bodies = [len(system.mass) - count for system, count in zip(systems, points, strict=True)]
    gathered, fixed = list[Any](), list[int]()
    firsts = {"points": 0, "bodies": sum(points)}
    for system in systems:
        kind = "bodies" if isinstance(system, RigidBodies) else "points"
        first, count = firsts[kind], len(system.mass)
        own = [effect for effect in system.effects if effect.name != OWN_TORQUE]
        gathered += [Part(effect, first, count, system.mass, kind == "bodies") for effect in own]
        fixed += [first + place for place in system.fixed]
        firsts[kind] += count
    cloths = [system for system, count in zip(systems, points, strict=True) if count]
    rigid: list[Any] = [system for system, count in zip(systems, bodies, strict=True) if count]
    torque = _common_torque(rigid)
    scene = RigidBodies(
        np.concatenate([system.mass for system in rigid]),
        np.concatenate([tensors(system.inertia) for system in rigid]),
        (*gathered, *as_effects(effects)),
        particles=np.concatenate([np.empty(0), *(system.mass for system in cloths)]),
        fixed=fixed,
    )
    kept = tuple(effect for effect in scene.effects if torque or effect.name != OWN_TORQUE)
    return fresh(scene, effects=kept, layout=layout_of(scene.own, kept), torque=torque, composed=True)


def _common_torque(systems: Sequence[RigidBodies]) -> bool:
    """Whether the gyroscopic torque is in a scene: all parts must agree that call for it."""
    with_it = [system for system in systems if any(effect.name == OWN_TORQUE for effect in system.effects)]
    torque = all(system.torque for system in systems)
    if with_it and not torque:
        raise ValueError("systems must agree on the gyroscopic torque; it was taken out of some of them alone")
    return torque


def compose_states(systems: Sequence[System], states: Sequence[Any]) -> Array:
    """The state of `compose(*systems)` from those of its parts."""
    _check_parts(systems)
    if len(systems) != len(states):
        raise ValueError(f"states must be one for each of the {len(systems)} systems; got {len(states)}")
    parts: tuple[list[Array], ...] = ([], [], [], [])
    for number, (system, y) in enumerate(zip(systems, states, strict=True)):
        y, kind = as_array(f"states[{number}]", y, (system.size,)), isinstance(system, RigidBodies)
        parts[0 + kind].append(y[: system.width])
        parts[2 + kind].append(y[system.width :])
    return np.concatenate([np.empty(0), *(value for part in parts for value in part)])


def _check_parts(systems: Sequence[System]) -> None:
    for system in systems:
        if not isinstance(system, System) or system.dimension != 3:
            raise ValueError(f"systems must be in 3-D, System or RigidBodies; got {system!r:.60}")
        if isinstance(system, RigidBodies) and (system.composed or system.frame.particles):
            raise ValueError("systems must be plain; got one that is composed already: give all its parts at once")
    if not any(isinstance(system, RigidBodies) for system in systems):
        raise ValueError("compose needs at least one RigidBodies; particles alone are one System")


class Part:
    """An effect of one part of a scene: its centres are first, ..., first + count - 1."""

    def __init__(self, effect: Any, first: int, count: int, mass: Array, of_bodies: bool) -> None:
        self.effect, self.first, self.count, self.mass = effect, first, count, mass
        self.of_bodies = of_bodies

    @property
    def name(self) -> str:
        return str(self.effect.name)

    def force(self, t: float, q: Array, v: Array) -> Array:
        raise ValueError(f"{self.name} belongs to a part of a scene")

    def bind_bodies(self, frame: BodyLayout) -> Any:
        centres, masses = self.first + np.arange(self.count), slice(self.first, self.first + self.count)
        if isinstance(self.effect, AtPoints):
            old = self.effect.markers
            markers = Markers(frame, self.first + old.to, old.at)
            return AtPoints(self.effect.effect, markers, masses if old.centred else None)
        if self.of_bodies and not hasattr(self.effect, "bind_bodies"):
            raise ValueError(f"{self.name} cannot be moved into a scene: what its bind_bodies returned has none itself")
        if self.of_bodies:
            return self.effect.bind_bodies(frame.part(self.first - frame.particles, self.count))
        markers = Markers(frame, centres, np.zeros((self.count, 3)))
        return AtPoints(bound(self.effect, self.mass), markers, masses)


def _on_bodies(effect: Any, mass: Array, frame: BodyLayout) -> Any:
    if isinstance(effect, AtPoints):
        return effect.rebound(mass, frame)
    if hasattr(effect, "bind_bodies"):
        return as_effects(effect.bind_bodies(frame))[0]
    return AtPoints(bound(effect, mass), Markers(frame))


def as_inertia(value: Any, count: int) -> Array:
    """(B,3,3) -> (B,6), checked: symmetric, positive definite, and a body can have it."""
    matrices = as_array("inertia", value)
    if matrices.shape == (3, 3):
        matrices = np.broadcast_to(matrices, (count, 3, 3))
    if matrices.shape != (count, 3, 3):
        raise ValueError(f"inertia must have shape ({count}, 3, 3), or (3, 3) for all bodies; got {matrices.shape}")
    size = np.abs(matrices).max(axis=(1, 2))
    for body, (matrix, largest) in enumerate(zip(matrices, size, strict=True)):
        if np.abs(matrix - matrix.T).max() > 1e-9 * largest:
            raise ValueError(f"inertia must be symmetric; that of body {body} is not: {matrix.tolist()}")
        moments = np.linalg.eigvalsh(matrix)
        if moments[0] <= 1e-14 * largest:
            raise ValueError(f"inertia must be positive definite; body {body} has principal moments {_listed(moments)}")
        if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
            raise ValueError(
                f"inertia: no principal moment may exceed the sum of the others; body {body} has {_listed(moments)} "
                "(is it about the centre of mass?)"
            )
    six = np.stack([matrices[:, i, j] for i, j in ENTRIES], axis=1)
    six.setflags(write=False)
    return six


def _listed(moments: Array) -> str:
    return ", ".join(f"{value:.6g}" for value in moments)
