"""Generated checks of rigid bodies: effects against differences over small turns, and problems for every stepper."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Actuation, AngularDrag, Attached, Drag, Gravity, SpringDamping, Springs, TorqueActuation
from dsim.effects.rows import has_rows
from dsim.rigid import RigidBodies
from dsim.studies.check import Check
from dsim.studies.convergence import OrderProblem, with_reference
from dsim.studies.derivatives import deviation, jacobian, verdict
from dsim.studies.reference import LSODA
from dsim.studies.steps import StepProblem


@dataclass(frozen=True)
class BodyEffectExample:
    """An effect of bodies for the generated checks: make(rng, bodies) builds a generic one, or None for bodies that
    have the effect of themselves."""

    name: str
    make: Callable[[np.random.Generator, int], Any]


def generic_inertia(rng: np.random.Generator, bodies: int) -> Array:
    """(B,3,3), three different moments and axes that are not those of the body's frame."""
    axes = np.linalg.qr(rng.normal(size=(bodies, 3, 3)))[0]
    return np.asarray(
        axes * rng.uniform([0.8, 1.2, 1.6], [1.0, 1.5, 1.9], (bodies, 3))[:, None, :] @ axes.swapaxes(1, 2)
    )


def generic_bodies(effects: Any, rng: np.random.Generator, bodies: int = 3) -> tuple[RigidBodies, Array]:
    """Bodies of generic inertia under some effects, and a generic state."""
    system = RigidBodies(rng.uniform(0.5, 2.0, bodies), generic_inertia(rng, bodies), effects)
    position, velocity, spin = rng.normal(size=(3, bodies, 3))
    return system, system.state(position, rng.normal(size=(bodies, 4)), velocity, spin)


def corners(rng: np.random.Generator, bodies: int, points: int = 4) -> tuple[Any, Array]:
    """Points on bodies: which, and where in their frames."""
    return np.arange(points) % bodies, rng.normal(size=(points, 3))


def check_body_effect(example: BodyEffectExample, seed: int = 0) -> tuple[Check, ...]:
    """Force Jacobians by small turns, velocities and parameters, the energy and the products of an effect."""
    return tuple(_effect_checks(example, seed))


def _effect_checks(example: BodyEffectExample, seed: int) -> Iterator[Check]:
    rng = np.random.default_rng(seed)
    made = example.make(rng, 3)
    system, y = generic_bodies(() if made is None else (made,), rng)
    effect: Any = next(e for e in system.effects if made is None or e.name == made.name)
    t, (q, v), w = 0.03, system.blocks(y), rng.normal(size=system.n)
    frame, subject = system.frame, f"{example.name}, bodies"

    def turned(delta: Array) -> Array:
        return q + frame.change_of(q, delta)

    zero = np.zeros(system.n)
    measured = {
        "dq": jacobian(lambda d: system.force(t, _unit(system, turned(d)), v), zero),
        "dv": jacobian(lambda z: system.force(t, q, z), v),
        "dtheta": jacobian(lambda p: system.with_theta(p).force(t, q, v), system.theta),
    }
    for name, total in (("dq", system.dq), ("dv", system.dv), ("dtheta", system.dtheta)):
        yield verdict(subject, f"{name} of the force", deviation(total(t, q, v), measured[name]))
    if getattr(effect, "energy", None) is not None:
        slope = jacobian(lambda d: np.array([effect.energy(t, _unit(system, turned(d)))]), zero)[0]
        yield verdict(subject, "force = -d energy/dq", deviation(-effect.force(t, q, v), slope))
    theta_bar = np.zeros(system.parameter_count)
    by_q, by_v = system.vjp(t, q, v, w, theta_bar)
    expected = np.concatenate([measured[name].T @ w for name in ("dq", "dv", "dtheta")])
    yield verdict(subject, "vjp = transposed Jacobians", deviation(np.concatenate([by_q, by_v, theta_bar]), expected))
    if has_rows(effect):
        force = effect.force(t, q, v)
        yield verdict(subject, "rows = force", deviation(_by_rows(effect.rows(), t, q, v), force), 1e-13)


@dataclass(frozen=True)
class _Given:
    poses: Array


def _by_rows(rows: Any, t: float, q: Array, v: Array) -> Array:
    """A force (n,) on bodies alone by what an explicit run evaluates in place."""
    before = np.linspace(-1.0, 1.0, len(v)).reshape(6, -1)
    after = before.copy()
    if hasattr(rows, "constant"):
        after += rows.constant
    else:
        rows.add_force(t, _Given(q.reshape(-1, 7).T.copy()), v.reshape(-1, 6).T.copy(), after)
    return np.asarray((after - before).T.ravel())


def _unit(system: RigidBodies, q: Array) -> Array:
    q = q.copy()
    turns = system.frame.turns(q)
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return q


def tied_bodies(seed: int = 0) -> StepProblem:
    """Two bodies under every kind of effect at once, tied by springs and dampers between their corners."""
    rng, h = np.random.default_rng(seed), 0.05
    to, at = corners(rng, 2, points=3)
    effects = (
        Gravity([0.3, -0.2, -9.81]),
        AngularDrag(rng.uniform(0.1, 0.3, 2)),
        Attached(Springs([(0, 1), (1, 2)], 0.7, rng.uniform(10, 30, 2)), to, at),
        Attached(SpringDamping([(0, 1)], rng.uniform(0.5, 1.5, 1)), to, at),
        Attached(Actuation(rng.normal(size=(2, 3, 3)), h), to, at),
        TorqueActuation(rng.normal(size=(2, 2, 3)), h),
    )
    system, y0 = generic_bodies(effects, rng, bodies=2)
    return StepProblem("tied bodies", system, y0, h)


def tumbling_in_wind() -> OrderProblem:
    """Two bodies of three different moments, tied by a spring at their corners, in air; nothing is periodic."""
    rng = np.random.default_rng(5)
    effects = (
        Gravity([0.0, 0.0, -9.81]),
        AngularDrag(0.2),
        Attached(Springs([(0, 1)], 0.6, 8.0), [0, 1], 0.4 * rng.normal(size=(2, 3))),
        Attached(Drag(0.15, wind=[1.0, 0.0, 0.0]), [0, 1], 0.3 * rng.normal(size=(2, 3))),
    )
    system = RigidBodies([1.0, 1.5], generic_inertia(rng, 2), effects)
    y0 = system.state(
        [[0, 0, 0], [1.2, 0, 0]], rng.normal(size=(2, 4)), 0.3 * rng.normal(size=(2, 3)), [1.0, -0.8, 1.3]
    )
    return with_reference("tumbling in wind", system, y0, 1.0, LSODA)  # Radau would take half a minute
