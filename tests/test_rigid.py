"""Rigid bodies: derivatives of every effect, every stepper on quaternions, momenta, composition, bad input."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from dsim import adjoint, catalog, plan, sensitivity, simulate
from dsim.arrays import rotation
from dsim.effects import AngularDrag, Attached, Drag, Gravity, SpringDamping, Springs, TorqueActuation
from dsim.effects.gyroscopic import Gyroscopic
from dsim.rigid import RigidBodies, compose, compose_states
from dsim.simulation import SimulationError, record
from dsim.steppers import RKMK4, BackwardEuler, ForwardEuler, ImplicitMidpoint, NormalisedEuler, SymplecticEuler
from dsim.steppers.charts import chart_of
from dsim.studies import check_gradient
from dsim.studies.bodies import check_body_effect, generic_bodies, generic_inertia, tied_bodies
from dsim.studies.convergence import check_order
from dsim.studies.steps import check_stepper
from dsim.system import System

NAMES = {type(stepper).__name__: stepper for stepper in catalog.BODY_STEPPERS}
EXAMPLES = {example.name: example for example in catalog.BODY_EFFECTS}
RNG = np.random.default_rng(0)


def failures(checks):
    return [str(check) for check in checks if not check.passed]


@pytest.mark.parametrize("name", EXAMPLES)
def test_body_effect_derivatives(name):
    checks = check_body_effect(EXAMPLES[name], seed=3)
    assert len(checks) >= 4 and not failures(checks)


@pytest.mark.parametrize("name", EXAMPLES)
def test_matrices_of_many_bodies_are_those_of_few(name, monkeypatch):
    """Arrays up to so many numbers, sparse above: the same derivatives by both."""
    from scipy.sparse import issparse

    example, rng = EXAMPLES[name], np.random.default_rng(4)
    made = example.make(rng, 3)
    system, y = generic_bodies(() if made is None else (made,), rng)
    few = [system.dq(0.03, *system.blocks(y)).toarray(), system.dv(0.03, *system.blocks(y)).toarray()]
    for module in ("bodies", "at_points"):
        monkeypatch.setattr(f"dsim.effects.{module}.FEW", 0)
    many = [getattr(e, c)(0.03, *system.blocks(y)) for c in ("dq", "dv") for e in system.having(c)]
    assert all(issparse(matrix) for matrix in many)
    assert np.allclose(few[0], system.dq(0.03, *system.blocks(y)).toarray(), rtol=1e-13, atol=1e-13)
    assert np.allclose(few[1], system.dv(0.03, *system.blocks(y)).toarray(), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_stepper_linearization_on_bodies(name):
    checks = check_stepper(NAMES[name], tied_bodies(), seed=1)
    assert len(checks) >= 8 and not failures(checks)


@pytest.fixture(scope="module")
def order_problem():
    return catalog.BODY_ORDER_PROBLEMS[0]()


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in ("SymplecticEuler", "RKMK4") else pytest.mark.slow) for n in NAMES]
)
def test_observed_order_on_bodies(name, order_problem):
    check, fit = check_order(NAMES[name], order_problem)
    assert check.passed and len(fit.h) == 6 and fit.r_squared >= 0.999, check


# Mutations: the checks above must be able to fail


def test_a_wrong_gyroscopic_derivative_is_red(monkeypatch):
    right = Gyroscopic.dv
    monkeypatch.setattr(Gyroscopic, "dv", lambda self, t, q, v: 0.99 * right(self, t, q, v))
    assert "dv of the force" in " ".join(failures(check_body_effect(EXAMPLES["gyroscopic"])))


@pytest.mark.parametrize("name", ["springs at corners", "torque", "damping at corners"])
def test_a_dropped_turn_is_red(name, monkeypatch):
    """An inertia, an arm or a torque that does not turn with the body."""
    from dsim.effects.at_points import Markers

    monkeypatch.setattr(Markers, "turning", lambda self, q, f: 0 * self.jacobian(q).T @ self.jacobian(q))
    right = TorqueActuation._dq
    monkeypatch.setattr(TorqueActuation, "_dq", lambda self, t, q, v: 0 * right(self, t, q, v))
    assert "dq of the force" in " ".join(failures(check_body_effect(EXAMPLES[name])))


@pytest.mark.parametrize("tangent", ["exponential_tangent", "cayley_tangent"])
def test_a_wrong_map_of_rotations_is_red(tangent, monkeypatch):
    """Mutation: as if a change of the turn were the change of its vector."""
    monkeypatch.setattr(rotation, tangent, lambda r: np.broadcast_to(np.eye(3), (*r.shape, 3)))
    stepper = BackwardEuler() if tangent.startswith("exponential") else ImplicitMidpoint()
    red = " ".join(failures(check_stepper(stepper, tied_bodies())))
    assert "Taylor remainder slope" in red or "A = dR/dy1" in red


def test_rk4_with_an_exponential_drops_to_order_two(order_problem):
    class Plain(RKMK4):
        rotation = "exponential"

    check, fit = check_order(Plain(), order_problem)
    assert not check.passed and abs(fit.order - 2) < 0.2


# What the true motion keeps


def world_momentum(system, y):
    """L (3,) of bodies about the origin."""
    q, v = system.blocks(y)
    frame = system.frame
    spin = rotation.rotate(frame.turns(q), frame.spins(system.momentum(v)))
    linear = system.mass[:, None] * frame.velocities_of(v)
    return spin.sum(axis=0) + np.cross(frame.centres_of(q), linear).sum(axis=0), linear.sum(axis=0)


def test_midpoint_keeps_world_angular_momentum_and_energy_of_free_bodies():
    system, y0 = generic_bodies((), np.random.default_rng(2))
    run = simulate(ImplicitMidpoint(tol=1e-14), system, y0, 0.05, 200)
    momenta = np.array([world_momentum(system, y)[0] for y in run.y])
    energies = np.array([system.energy(t, y) for t, y in zip(run.t, run.y, strict=True)])
    assert np.abs(momenta - momenta[0]).max() <= 1e-12 * np.abs(momenta).max()
    assert np.ptp(energies) <= 1e-12 * energies[0]
    drift = simulate(ForwardEuler(), system, y0, 0.05, 200)
    assert np.abs(world_momentum(system, drift.last)[0] - momenta[0]).max() > 1e-2


def test_the_exponential_in_the_midpoint_rule_would_drift():
    class Exponential(ImplicitMidpoint):
        rotation = "exponential"

    system, y0 = generic_bodies((), np.random.default_rng(2))
    run = simulate(Exponential(tol=1e-14), system, y0, 0.05, 50)
    momenta = np.array([world_momentum(system, y)[0] for y in run.y])
    assert 1e-9 < np.abs(momenta - momenta[0]).max() < 1e-1


@pytest.mark.parametrize("name", NAMES)
def test_internal_forces_keep_momentum_and_quaternions_stay_unit(name):
    rng = np.random.default_rng(4)
    ties = Attached(Springs([(0, 1), (1, 2), (2, 3)], 0.6, 20.0), [0, 1, 2, 0], rng.normal(size=(4, 3)))
    system, y0 = generic_bodies((ties,), rng)
    run = simulate(NAMES[name], system, y0, 0.01, 50)
    linear = [world_momentum(system, y)[1] for y in run.y]
    assert np.abs(np.array(linear) - linear[0]).max() <= 1e-12
    norms = np.linalg.norm(np.array([system.frame.turns(y[: system.width]) for y in run.y]), axis=-1)
    assert np.abs(norms - 1).max() <= 1e-14


def test_the_notes_loop_is_symplectic_euler_with_the_cayley_map():
    """Sum forces and torques, update velocities, update places, normalise: ten lines beside the stepper."""
    system, y0 = generic_bodies((Gravity([0.0, 0.0, -9.81]), AngularDrag(0.3)), np.random.default_rng(6), bodies=2)
    h, frame = 0.01, system.frame
    q, v = (part.copy() for part in system.blocks(y0))
    for _ in range(30):
        v = v + h * system.stage_solve(system.force(0.0, q, v))
        q = q + h * frame.change_of(q, v)
        turns = frame.turns(q)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    run = simulate(NormalisedEuler(), system, y0, h, 30)
    assert np.abs(run.last - np.concatenate([q, v])).max() <= 1e-13


def test_a_sphere_of_points_moves_as_points_do():
    """Bodies whose attitude nobody asks for are particles, to the last digit that matters."""
    x, v = RNG.normal(size=(2, 4, 3))
    effects = [Gravity([0, 0, -9.81]), Drag(0.3), Springs([(0, 1), (2, 3)], 0.5, 30.0), SpringDamping([(0, 1)], 0.4)]
    mass = RNG.uniform(0.5, 2, 4)
    points, bodies = System(mass, effects), RigidBodies(mass, np.eye(3), effects)
    one = simulate(BackwardEuler(), points, np.concatenate([x.ravel(), v.ravel()]), 0.02, 30)
    other = simulate(BackwardEuler(), bodies, bodies.state(x, None, v), 0.02, 30)
    assert np.abs(bodies.frame.centres_of(other.last[: bodies.width]).ravel() - one.last[:12]).max() <= 1e-12


def test_gyroscopic_torque_is_there_only_where_it_acts():
    ball, box = np.eye(3), np.diag([1.0, 2.0, 2.5])
    assert RigidBodies([1.0, 1.0], ball).effects == ()
    mixed = RigidBodies([1.0, 1.0], [ball, box])
    assert [effect.name for effect in mixed.effects] == ["gyroscopic"] and list(mixed.effects[0].acting) == [1]
    line = {line.stage: line for line in plan(mixed, SymplecticEuler(), mixed.state(np.zeros(3)), 0.01).lines}
    assert line["gyroscopic"].state == "on"
    calm = RigidBodies([1.0], ball)
    line = {line.stage: line for line in plan(calm, SymplecticEuler(), calm.state(np.zeros(3)), 0.01).lines}
    assert line["gyroscopic torque"].state == "off" and "isotropic" in line["gyroscopic torque"].why


def test_gyroscopic_on_or_off_agrees_for_a_sphere_and_so_does_the_gradient_by_its_inertia():
    """The torque of a sphere is 0, its derivative by the inertia is not: it must not be lost with the torque."""
    system = RigidBodies([1.0], 1.5 * np.eye(3))
    y0 = system.state([0, 0, 0], [1, 2, 3, 4], 0.0, [0.5, -1.0, 2.0])
    forced = copy.copy(system)
    object.__setattr__(forced, "effects", (Gyroscopic(system.inertia, system.frame),))
    object.__setattr__(forced, "layout", RigidBodies([1.0], np.diag([1.0, 1.5, 2.0])).layout)
    a, b = (simulate(SymplecticEuler(), s, y0, 0.05, 10) for s in (system, forced))
    assert np.abs(a.last - b.last).max() <= 1e-13

    def cost(six):
        there = system.with_theta(system.join(inertia=six[None]))
        run = simulate(SymplecticEuler(), there, y0, 0.05, 10)
        return run.last @ run.last / 2 + run.last[-1], adjoint(run, run.last + np.eye(len(y0))[-1])["inertia"][0]

    assert check_gradient(cost, system.inertia[0]).verdict == "smooth"
    assert np.abs(cost(system.inertia[0])[1][3:]).max() > 1e-3


def test_a_start_of_any_norm_is_an_attitude_and_its_gradient_is_right():
    system, y0 = generic_bodies((Gravity([0, 0, -9.81]), AngularDrag(0.2)), np.random.default_rng(8), bodies=1)
    scaled = y0.copy()
    scaled[3:7] *= 3.0
    run, same = (simulate(SymplecticEuler(), system, y, 0.02, 6) for y in (scaled, y0))
    assert np.abs(run.last - same.last).max() <= 1e-14

    def cost(q):
        y = scaled.copy()
        y[3:7] = q
        r = simulate(SymplecticEuler(), system, y, 0.02, 6)
        return r.last @ r.last / 2 + r.last[3], adjoint(r, r.last + np.eye(13)[3]).y0[3:7]

    assert check_gradient(cost, scaled[3:7]).verdict == "smooth"
    assert abs(cost(scaled[3:7])[1] @ scaled[3:7]) <= 1e-12  # nothing along the quaternion itself


# Composition


def tied_scene():
    """A little net, pinned at one point, and two bodies, the first of which hangs from the net by its corner."""
    net = System([0.2, 0.3, 0.2], [Gravity([0, 0, -9.81]), Springs([(0, 1), (1, 2)], 0.4, 60.0)], fixed=[0])
    two, _ = generic_bodies((AngularDrag(0.1, name="stir"),), np.random.default_rng(1), bodies=2)
    tie = Attached(Springs([(0, 1)], 0.2, 80.0, name="tie"), [2, 3], [[0, 0, 0], [0.1, 0.2, 0.3]])
    weight = Gravity([0, 0, -9.81], name="weight")
    bodies = RigidBodies(
        two.mass, generic_inertia(np.random.default_rng(1), 2), [AngularDrag(0.1, name="stir"), weight]
    )
    scene = compose(net, bodies, effects=[tie])
    y = compose_states([net, bodies], [
        np.array([0, 0, 0, 0.4, 0, 0, 0.8, 0, 0, *np.zeros(9)]),
        bodies.state([[0.9, 0, -0.3], [2, 0, 0]], RNG.normal(size=(2, 4)), [0.1, 0.1, 0.1], RNG.normal(size=(2, 3))),
    ])  # fmt: skip
    return net, bodies, scene, y


@pytest.mark.parametrize("name", ["SymplecticEuler", "BackwardEuler", "ImplicitMidpoint", "RK4", "RKMK4"])
def test_a_cloth_and_bodies_in_one_scene(name):
    _, _, scene, y = tied_scene()
    assert scene.frame.particles == 3 and scene.frame.bodies == 2 and y.shape == (scene.size,)
    run = simulate(NAMES[name], scene, y, 0.01, 20)
    assert np.abs(run.q[:, :3]).max() == 0  # the pinned point
    rng = np.random.default_rng(0)
    w, dy0, dtheta = rng.normal(size=run.y.shape), rng.normal(size=scene.size), rng.normal(size=scene.parameter_count)
    gradient, tangent = adjoint(run, w), sensitivity(run, dy0, dtheta)
    backward = gradient.y0 @ dy0 + gradient.theta @ dtheta
    forward = (w * tangent).sum()
    assert abs(forward - backward) <= 1e-10 * abs(forward)
    if name == "BackwardEuler":
        assert not failures(check_stepper(NAMES[name], replace(tied_bodies(), system=scene, y0=y, h=0.02)))


def test_parts_that_are_not_tied_move_as_alone():
    net, bodies, _, _ = tied_scene()
    scene = compose(net, bodies)
    states = [
        np.array([0, 0, 0, 0.4, 0, 0, 0.8, 0, 0, *np.zeros(9)]),
        bodies.state([[1, 0, 0], [2, 0, 0]], None, 0, [1.0, 1.0, 1.0]),
    ]
    whole = simulate(SymplecticEuler(), scene, compose_states([net, bodies], states), 0.01, 40)
    alone = [simulate(SymplecticEuler(), s, y, 0.01, 40).last for s, y in zip((net, bodies), states, strict=True)]
    assert np.abs(whole.last - compose_states([net, bodies], alone)).max() <= 1e-12


# Bad input: one clear error each

GOOD = {"mass": [1.0], "inertia": np.eye(3)}


@pytest.mark.parametrize(
    "values, words",
    [
        ({"mass": []}, "mass must have at least one body"),
        ({"mass": [-1.0]}, "mass must be > 0"),
        ({"inertia": np.ones((2, 2))}, r"inertia must have shape \(1, 3, 3\)"),
        ({"inertia": np.diag([1.0, 2.0, np.nan])}, "inertia must be finite"),
        ({"inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, "inertia must be symmetric; that of body 0"),
        ({"inertia": np.diag([1.0, 1.0, 0.0])}, "inertia must be positive definite"),
        ({"inertia": np.diag([1.0, 1.0, 3.0])}, "no principal moment may exceed the sum of the others"),
        ({"effects": [Gravity([0.0, -9.81])]}, "acceleration must have shape"),
        ({"effects": [Drag(0.1, name="gyroscopic")]}, "may not be called 'gyroscopic'"),
        ({"effects": [AngularDrag([0.1, 0.2])]}, "coefficient must have shape"),
        ({"effects": [Attached(Springs([(0, 1)], 1, 1), [0, 5], np.zeros((2, 3)))]}, "to must be indices from 0 to 0"),
        ({"effects": [TorqueActuation(np.zeros((2, 3, 3)), 0.1)]}, "torques must have shape"),
        ({"particles": [1.0], "fixed": [3]}, "fixed must be indices from 0 to 0"),
    ],
)  # fmt: skip
def test_bad_bodies_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        RigidBodies(**GOOD | values)


def test_bad_states_steppers_and_parts_are_refused():
    body = RigidBodies(**GOOD)
    cases = [
        (lambda: body.state([0, 0, 0], [0, 0, 0, 0]), "attitude must be quaternions other than 0"),
        (lambda: body.state([[0, 0]]), r"position must have shape \(1, 3\)"),
        (lambda: simulate(SymplecticEuler(), body, np.zeros(12), 0.1, 1), "y0 must have shape"),
        (lambda: simulate(SymplecticEuler(), body, np.zeros(13), 0.1, 1), "quaternions other than 0"),
        (lambda: simulate(catalog.STEPPERS[3], body, body.state([0, 0, 0]), 0.1, 1), "looks back over two states"),
        (lambda: compose(System([1.0])), "at least one RigidBodies"),
        (lambda: compose(body, System([1.0], dimension=2)), "systems must be in 3-D"),
        (lambda: compose(compose(body, System([1.0])), body), "composed already"),
        (lambda: Attached(Gravity([0, 0, -1]), [0], np.zeros((1, 3))), "acts on masses"),
        (lambda: Attached(Springs([(0, 1)], 1, 1), [0.5, 1], np.zeros((2, 3))), "to must be whole numbers"),
        (lambda: System([1.0], [Attached(Springs([(0, 1)], 1, 1), [0, 1], np.zeros((2, 3)))]), "RigidBodies"),
        (lambda: AngularDrag(-1.0), "coefficient must be >= 0"),
        (lambda: TorqueActuation(np.zeros((2, 3, 3)), 0.1, "moon"), 'frame must be "world" or "body"'),
    ]  # fmt: skip
    for call, words in cases:
        with pytest.raises(ValueError, match=words):
            call()


def test_a_run_that_spins_up_says_so():
    body = RigidBodies([1.0], np.diag([1.0, 1.2, 2.0]))
    y0 = body.state([0, 0, 0], None, 0.0, [5.0, 1.0, 100.0])
    assert str(record(ForwardEuler(), body, y0, 1 / 60, 60).status) == "not_finite"
    with pytest.raises(SimulationError, match="ForwardEuler failed"):
        simulate(ForwardEuler(), body, y0, 1 / 60, 60)


def test_charts_know_their_names():
    body = RigidBodies(**GOOD)
    with pytest.raises(ValueError, match="rotation must be one of"):
        chart_of(body, body.state([0, 0, 0]), "wheel")
