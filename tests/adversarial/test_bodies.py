"""What a reader whose aim was to break the bodies found: wrong numbers in silence first, then good input refused."""

from __future__ import annotations

import numpy as np
import pytest

from dsim import adjoint, plan, scenes, simulate
from dsim.arrays import rotation
from dsim.effects import AngularDrag, Attached, Drag, Field, Gravity, SpringDamping, Springs, TorqueActuation
from dsim.geometry import MassProperties, box, box_faces, polyhedron, solid, sphere
from dsim.gradients.objectives import Variables
from dsim.gradients.second_order import hessian_product
from dsim.pictures.rigid import box as coloured
from dsim.pictures.scene import film
from dsim.rigid import RigidBodies, compose, compose_states
from dsim.scenes import Scene
from dsim.simulation import Trajectory, record
from dsim.solve import Status
from dsim.steppers import RK4, RKMK4, BackwardEuler, ImplicitMidpoint, SymplecticEuler, Trapezoidal
from dsim.system import System

I = np.diag([1.0, 2.0, 2.5])
FALL = [0.0, 0.0, -9.81]


def names(system):
    return [effect.name for effect in system.effects]


# Scenes made of scenes


def test_compose_takes_parts_as_they_are_now():
    earth, point = RigidBodies([1.0], I, [Gravity(FALL)]), System([1.0])
    moon = earth.with_theta(earth.join(**{"gravity.acceleration": [0, 0, -1.62]}))
    assert compose(moon, point).split(compose(moon, point).theta)["gravity.acceleration"].tolist() == [0, 0, -1.62]
    assert names(compose(earth.without("gravity"), point)) == ["gyroscopic"]
    assert names(compose(earth.without("gyroscopic"), point)) == ["gravity"]
    tie = Attached(Springs([(0, 1)], 0.5, 20.0), [0, 1], [[1.0, 0, 0], [0, 1.0, 0]])
    pair = RigidBodies([1.0, 1.0], I, [tie])
    stiff = pair.with_theta(pair.join(**{"springs.stiffness": [99.0]}))
    y = pair.state([[0, 0, 0], [3, 0, 0]], [1, 2, 3, 4.0])
    both = compose(stiff, point)
    force = both.force(0.0, np.r_[np.zeros(3), y[:14]], np.zeros(15))[3:]
    assert np.allclose(force, stiff.force(0.0, *stiff.blocks(y)), rtol=1e-14)


def test_parts_disagree_on_the_gyroscopic_torque():
    with pytest.raises(ValueError, match="gyroscopic"):
        compose(RigidBodies([1.0], I), RigidBodies([1.0], I).without("gyroscopic"))
    left_out = RigidBodies([1.0], I).without("gyroscopic")
    assert names(compose(left_out, left_out)) == [] and names(compose(left_out, RigidBodies([1.0], np.eye(3)))) == []


def test_what_is_composed_is_not_composed_again():
    a = RigidBodies([1.0], np.eye(3), [AngularDrag(0.5)])
    with pytest.raises(ValueError, match="composed already"):
        compose(RigidBodies([1.0], np.eye(3)), compose(a, RigidBodies([1.0], np.eye(3))))


def test_a_torque_that_was_left_out_stays_out():
    system = RigidBodies([1.0], I, [AngularDrag(0.1)]).without("gyroscopic")
    y0 = system.state([0, 0, 0], [1, 2, 3, 4], 0.0, [1.0, 2, 3])
    again = system.with_theta(system.theta)
    assert names(again) == ["angular_drag"]
    run = simulate(SymplecticEuler(), system, y0, 0.05, 10)
    assert np.array_equal(run.last, simulate(SymplecticEuler(), again, y0, 0.05, 10).last)

    def value(theta):
        last = simulate(SymplecticEuler(), system.with_theta(theta), y0, 0.05, 10).last
        return 0.5 * last @ last

    by_theta = adjoint(run, run.last).theta
    for k in range(len(by_theta)):
        step = 1e-6 * np.eye(len(by_theta))[k]
        difference = (value(system.theta + step) - value(system.theta - step)) / 2e-6
        assert abs(by_theta[k] - difference) < 1e-7 * max(1.0, abs(difference)), k


def test_without_forgets_the_parameters():
    system = scenes.sign(steps=3).system
    whole = len(system.theta)  # and so it is cached
    rest = system.without("wind")
    assert len(rest.theta) == rest.parameter_count == whole - 4
    assert "wind.coefficient" not in rest.split(rest.theta)


def test_bound_effects_keep_their_places():
    tie = Attached(Springs([(0, 1)], 0.5, 100.0), [0, 1], [[1.0, 0, 0], [0, 1.0, 0]])
    one = RigidBodies([1.0, 1.0], np.eye(3), [tie, Gravity(FALL)])
    two = RigidBodies([1.0, 2.0], np.eye(3), one.effects)
    y = one.state([[0, 0, 0], [3, 0, 0]], [1, 2, 3, 4.0])
    spring = one.without("gravity").force(0.0, *one.blocks(y))
    assert np.allclose(two.without("gravity").force(0.0, *two.blocks(y)), spring)
    assert (two.force(0.0, *two.blocks(y)) - spring).reshape(2, 6)[:, 2].tolist() == pytest.approx([-9.81, -19.62])


# Derivatives


@pytest.mark.parametrize("steps", [1, 10])
def test_second_derivatives_by_a_small_inertia(steps):
    """v = n h tau / I: d2v/dI2 = 2 n h tau / I^3, of a golf ball."""
    ball = sphere(0.021, 0.046)
    I_zz = ball.inertia[2, 2]
    torque = TorqueActuation(np.tile([0, 0, 1e-5], (steps, 1, 1)), 0.01)
    system = RigidBodies([ball.mass], ball.inertia, [torque])
    run = simulate(SymplecticEuler(), system, system.state([0, 0, 0]), 0.01, steps)
    direction = np.eye(len(system.theta))[3]
    found = hessian_product(run, np.eye(13)[12], (None, direction)).theta[3]
    assert found == pytest.approx(2 * 0.01 * steps * 1e-5 / I_zz**3, rel=1e-7)


def test_second_derivatives_by_a_small_mass():
    system = RigidBodies([1e-6], np.eye(3), [Drag(1e-6)])
    run = simulate(SymplecticEuler(), system, system.state([0, 0, 0], None, [1.0, 0, 0]), 0.01, 1)
    found = hessian_product(run, np.eye(13)[7], (None, np.eye(len(system.theta))[0])).theta[0]
    assert found == pytest.approx(-2 * 0.01 * 1e-6 / 1e-18, rel=1e-7)  # v1 = v0 (1 - h c/m)


def test_a_subclass_that_overrides_the_force_is_warned_of():
    class Quadratic(AngularDrag):
        def force(self, t, q, v):
            return super().force(t, q, v) * np.abs(v)

    system = RigidBodies([1.0], I, [Quadratic(0.3)])
    lines = [str(line) for line in plan(system, SymplecticEuler(), system.state([0, 0, 0]), 0.01).warnings]
    assert len(lines) == 1 and "angular_drag" in lines[0] and "dv" in lines[0]


# Forces


class Push:
    name = "push"

    def __init__(self, value):
        self.value = value

    def force(self, t, q, v):
        return self.value


@pytest.mark.parametrize("value", [np.ones(3), np.ones(7), 1.0, None])
@pytest.mark.parametrize("attached", [False, True])
def test_a_force_of_another_shape_is_named(value, attached):
    effect = Attached(Push(value), [0, 1, 2], np.ones((3, 3))) if attached else Push(value)
    system = RigidBodies([1.0] * 3, I, [effect])
    with pytest.raises(ValueError, match=r"force of 'push' must return shape \(9,\); got \("):
        system.force(0.0, *system.blocks(system.state(np.zeros(3))))


def test_wrong_derivatives_of_points_are_named():
    class Wrong(Push):
        def dq(self, t, q, v):
            return np.eye(4)

    system = RigidBodies([1.0] * 3, I, [Attached(Wrong(np.ones(9)), [0, 1, 2], np.ones((3, 3)))])
    with pytest.raises(ValueError, match=r"dq of 'push' must return shape \(9, 9\); got \(4, 4\)"):
        system.dq(0.0, *system.blocks(system.state(np.zeros(3))))


def test_a_users_force_gets_numbers_of_its_own():
    """One body: rows and state are the same memory, unless copied."""
    seen = []

    class Log(Push):
        def bind_bodies(self, layout):
            return self

        def force(self, t, q, v):
            seen.append(q)
            v *= 0.5
            return np.zeros(6)

    system = RigidBodies([1.0], I, [Log(None)])
    run = simulate(SymplecticEuler(), system, system.state([0, 0, 0], None, [1.0, 0, 0], [0, 0, 3.0]), 0.1, 5)
    assert all(np.allclose(q, y[:7], atol=1e-15) for q, y in zip(seen, run.y, strict=False))
    assert run.last[7] == 1.0


@pytest.mark.parametrize("effect", [AngularDrag(0.1), TorqueActuation(np.zeros((2, 1, 3)), 0.1)])
def test_effects_of_bodies_are_not_for_points(effect):
    with pytest.raises(ValueError, match="give it to RigidBodies"):
        System([1.0], [effect])
    with pytest.raises(ValueError, match="acts on bodies"):
        Attached(effect, [0], [[1.0, 0, 0]])


def test_attached_to_points_or_twice_is_refused():
    springs = Attached(Springs([(0, 1)], 1.0, 1.0), [0, 1], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="give it to RigidBodies"):
        System([1.0, 1.0], [springs])
    with pytest.raises(ValueError, match="acts on bodies"):
        Attached(springs, [0, 1], np.zeros((2, 3)))


# Starts and states


def test_the_energy_of_a_start_of_any_norm():
    spring = Field(lambda x: -x, lambda x: -np.broadcast_to(np.eye(3), (len(x), 3, 3)), lambda x: 0.5 * (x**2).sum(1))
    tie = Attached(Springs([(0, 1)], 0.1, 10.0), [0, 0], [[0.5, 0, 0], [0, 0.5, 0]])
    system = RigidBodies([1.0], I, [tie, Attached(spring, [0], [[1.0, 0, 0]])])
    y = system.state([1, 0, 0], [1, 2, 3, 4.0])
    twice = y.copy()
    twice[3:7] *= 2
    assert system.energy(0.0, twice) == pytest.approx(system.energy(0.0, y), rel=1e-14)
    scene = Scene("one", "", system, twice, 0.01, 1, SymplecticEuler(), shapes=[box_faces([1.0, 1.0, 1.0])])
    assert np.ptp(film(scene, scene.simulate()).box, axis=0).max() < 3


@pytest.mark.parametrize("scale", [1e-170, 1e-300, 1e155, 1e200])
@pytest.mark.parametrize("stepper", [SymplecticEuler(), RK4(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_attitudes_of_extreme_norm(scale, stepper):
    system = RigidBodies([1.0], I)
    y = system.state([0, 0, 0], [1, 2, 3, 4.0], 0.0, [1.0, 2, 3])
    far = y.copy()
    far[3:7] *= scale
    assert np.allclose(simulate(stepper, system, far, 0.01, 3).last, simulate(stepper, system, y, 0.01, 3).last)


def test_a_saved_trajectory_knows_its_positions(tmp_path):
    system = RigidBodies([1.0, 1.0], I)
    run = simulate(SymplecticEuler(), system, system.state([0, 0, 0], None, [1, 2, 3], [4, 5, 6]), 0.1, 2)
    run.save(tmp_path / "t.npz")
    loaded = Trajectory.load(tmp_path / "t.npz")
    assert np.array_equal(loaded.q, run.q) and np.array_equal(loaded.v, run.v)


def test_what_a_system_is_made_of_cannot_be_changed():
    system = RigidBodies([1.0], I)
    for array in (system.inertia, system.mass):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 4.4


@pytest.mark.parametrize(
    "given",
    [
        {"attitude": 1.0},
        {"velocity": [1.0]},
        {"spin": 2.0},
        {"position": [[1.0], [2.0], [3.0]]},
        {"spin": np.ones((1, 3))},
    ],
)
def test_a_state_is_given_in_rows(given):
    system = RigidBodies([1.0] * 3, I)
    (name,) = given
    with pytest.raises(ValueError, match=f"{name} must have shape"):
        system.state(**{"position": [0, 0, 0], **given})


def test_angular_momentum_of_a_whole_scene_is_kept():
    tie = Attached(Springs([(0, 1), (2, 1)], 0.5, 5.0), [1, 2, 0], [[0.3, 0, 0], [0, 0.2, 0.1], [0, 0, 0]])
    bodies, point = RigidBodies([1.0, 2.0], [I, 2 * I]), System([0.5])
    system = compose(bodies, point, effects=[tie])
    parts = bodies.state([[0, 0, 0], [1, 0, 0]], [1, 2, 3, 4], [0.1, 0.2, 0.3], [1.0, -2, 0.5]), [2, 0, 1, 0, 0.3, 0.0]
    y0 = compose_states((bodies, point), parts)
    run = simulate(RKMK4(), system, y0, 0.005, 100)
    L = np.array([system.angular_momentum(y) for y in run.y])
    assert np.abs(L - L[0]).max() < 1e-8 * np.linalg.norm(L[0]) and np.abs(np.diff(L, axis=0)).max() > 0


def test_attitudes_and_spins_are_names_of_variables():
    bodies, point = RigidBodies([1.0, 2.0], [I, 2 * I]), System([0.5])
    y0 = compose_states((bodies, point), (bodies.state([0, 0, 0], [1, 0, 0, 0], 0.0, [1.0, 2, 3]), np.zeros(6)))
    system = compose(bodies, point)
    assert Variables(system, y0, ["spins"]).start.tolist() == [1, 2, 3, 1, 2, 3]
    assert Variables(system, y0, ["attitudes"]).start.tolist() == [1, 0, 0, 0] * 2


# Runs that must go on


def test_a_body_at_rest_stays_at_rest():
    """Below the round-off of the positions nothing can be solved, and nothing need be."""
    k = 1e4
    hook, body, rest = System([1.0], fixed=[0]), RigidBodies([1.0], np.eye(3)), -(1 + 9.81 / 1e4)
    scene = compose(hook, body, effects=[Gravity(FALL), Springs([(0, 1)], 1.0, k)])
    y0 = compose_states((hook, body), (np.zeros(6), body.state([0, 0, rest])))
    for stepper in (BackwardEuler(), ImplicitMidpoint(), Trapezoidal(), BackwardEuler(tol=1e-4)):
        run = record(stepper, scene, y0, 0.01, 20)
        assert run.status is Status.CONVERGED and len(run.t) == 21, type(stepper).__name__


def test_a_damped_board_comes_to_rest_and_goes_on():
    corner = Attached(Springs([(0, 1)], 0.5, 1000.0), [0, 1], [[0, 0, 0], [0.3, 0, 0.2]])
    damped = Attached(SpringDamping([(0, 1)], 5.0), [0, 1], [[0, 0, 0], [0.3, 0, 0.2]])
    hook, plate = System([1.0], fixed=[0]), box([0.6, 0.03, 0.4], 1.5)
    board = RigidBodies([plate.mass], plate.inertia, [AngularDrag(0.3)])
    scene = compose(hook, board, effects=[Gravity(FALL), corner, damped])
    y0 = compose_states((hook, board), (np.zeros(6), board.state([0, 0, -0.7])))
    run = record(BackwardEuler(), scene, y0, 0.1, 700)
    assert run.status is Status.CONVERGED and np.abs(run.last[scene.width :]).max() < 1e-9


def test_advice_names_what_helps():
    from dsim.simulation import explain

    system = RigidBodies([1.0], I)
    failed = Trajectory(BackwardEuler(), system, 0.1, np.zeros(1), np.zeros((1, 13)), Status.LINE_SEARCH_FAILED)
    assert "energy" not in explain(failed)


# Shapes


def cube(size=1.0, at=0.0, inward=False):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) * size + at
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip
    return corners, np.array(faces)[:, ::-1] if inward else np.array(faces)


def test_a_mesh_with_a_part_inside_out_is_refused():
    (a, f), (b, g) = cube(2.0), cube(1.0, at=5.0, inward=True)
    with pytest.raises(ValueError, match="inside out"):
        solid(np.concatenate([a, b]), np.concatenate([f, g + 8]), 1.0)
    (b, g) = cube(1.0, at=0.5, inward=True)  # a hollow is one, and is no mistake
    hollow = solid(np.concatenate([a, b]), np.concatenate([f, g + 8]), 1.0)
    full, hole = solid(a, f, 8.0), solid(*cube(1.0, at=0.5), 1.0)
    assert np.allclose(7 * hollow.inertia, full.inertia - hole.inertia)


def test_unused_vertices_do_not_count():
    corners, faces = cube()
    far = solid(np.concatenate([corners, [[1e5, 0, 0]]]), faces, 1.0)
    assert np.allclose(far.inertia, solid(corners, faces, 1.0).inertia, rtol=1e-12)


@pytest.mark.parametrize("inertia", [-np.eye(3), np.diag([1.0, 1.0, 3.0]), [[1, 1, 0], [0, 1, 0], [0, 0, 1]]])
def test_mass_properties_are_those_of_a_body(inertia):
    with pytest.raises(ValueError, match="inertia"):
        MassProperties(1.0, [0, 0, 0], inertia)
    assert (MassProperties(1.0, [0, 0, 0], np.zeros((3, 3))) + sphere(1.0, 1.0)).mass == 2  # a point mass is a part


def test_shapes_add_up_and_refuse_numbers():
    assert sum([sphere(1.0, 1.0), sphere(1.0, 2.0)]).mass == 3.0
    with pytest.raises(TypeError):
        sphere(1.0, 1.0) + 1
    for make in (lambda: solid(np.zeros((0, 3)), np.zeros((0, 3), int), 1), lambda: polyhedron(np.zeros((0, 3)), 1)):
        with pytest.raises(ValueError, match=r"vertices|faces"):
            make()


def test_a_singular_inertia_is_named():
    system = RigidBodies([1.0, 1.0], I)
    six = system.inertia.copy()
    six[1] = 0.0
    with pytest.raises(ValueError, match="inertia of body 1 has no inverse"):
        simulate(SymplecticEuler(), system.with_theta(system.join(inertia=six)), system.state([0, 0, 0]), 0.1, 1)


# Scenes for pictures


@pytest.mark.parametrize(
    ("change", "words"),
    [({"knots": ([0.7], [[0, 0, 1.0]])}, "whole numbers"), ({"knots": (["a"], [[0, 0, 1.0]])}, "whole numbers"),
     ({"knots": None}, "knots must be"), ({"knots": ([0],)}, "knots must be"),
     ({"knots": ([0], [1.0, 2, 3, 4])}, "knots"), ({"shapes": 3}, "shapes must be"),
     ({"shapes": [None]}, "shapes must be"), ({"shapes": [[[[0, 0, 0], [1, 1, 1]]]]}, "3 corners"),
     ({"shapes": [coloured([1, 1, 1])]}, "without colours")],
)  # fmt: skip
def test_drawings_that_are_none(change, words):
    given = {"shapes": [box_faces([1, 1, 1])]} | change
    system = RigidBodies([1.0], I)
    with pytest.raises(ValueError, match=words):
        Scene("one", "", system, system.state([0, 0, 0]), 0.01, 1, SymplecticEuler(), **given)


def test_knots_on_particles_have_no_extent():
    scene = scenes.sign()
    with pytest.raises(ValueError, match="particles"):
        Scene("one", "", scene.system, scene.y0, 0.01, 1, SymplecticEuler(), knots=([0], [[0, 0, 1.0]]))
    with pytest.raises(ValueError, match="knots"):
        Scene("one", "", System([1.0]), np.zeros(6), 0.01, 1, SymplecticEuler(), knots=([0], [[0, 0, 0.0]]))


def test_states_and_parts_are_as_many():
    with pytest.raises(ValueError, match="states must be one for each of the 1 systems; got 0"):
        compose_states([RigidBodies([1.0], I)], [])


def test_rotations_take_lists():
    assert rotation.rotate([1.0, 0, 0, 0], [1.0, 2, 3]).tolist() == [1, 2, 3]
    assert rotation.exponential([0.0, 0, 0]).tolist() == [1, 0, 0, 0]
    assert rotation.product([1, 0, 0, 0], [0, 1, 0, 0]).tolist() == [0, 1, 0, 0]
