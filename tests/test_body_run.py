"""Explicit runs of bodies on component rows: the states of the plain path, and nothing evaluated in vain."""

import numpy as np
import pytest

from dsim import adjoint, catalog, plan, simulate
from dsim.arrays import rotation
from dsim.effects import AngularDrag, Drag, Gravity
from dsim.effects.gyroscopic import GyroscopicRows, InertiaRows, angular_momentum
from dsim.rigid import RigidBodies, compose
from dsim.simulation import _stepwise, record
from dsim.solve import Status
from dsim.steppers import RK4, BackwardEuler, ForwardEuler, SymplecticEuler, VelocityVerlet, body_run
from dsim.studies.bodies import check_body_effect, generic_bodies
from dsim.system import System

STEPPERS = [s for s in catalog.BODY_STEPPERS if not s.implicit and s.rotation in ("exponential", "cayley")]
RNG = np.random.default_rng(0)


def plainly(stepper, system, y0, h, steps):
    y = np.empty((steps + 1, system.size))
    y[0] = y0
    return _stepwise(stepper, system, y, h, "states")


def generic(example, bodies=4, seed=0):
    rng = np.random.default_rng(seed)
    made = example.make(rng, bodies)
    return generic_bodies(() if made is None else (made,), rng, bodies)


def test_there_are_four_such_steppers():
    assert [type(s).__name__ for s in STEPPERS] == [
        "ForwardEuler",
        "SymplecticEuler",
        "NormalisedEuler",
        "VelocityVerlet",
    ]


@pytest.mark.parametrize("example", catalog.BODY_EFFECTS, ids=lambda e: e.name)
@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: type(s).__name__)
def test_rows_and_plain_path_agree(stepper, example):
    system, y0 = generic(example)
    steps = 3 if hasattr(system.effects[0], "at") else 20  # given torques are three rows of 0.02 s
    run, plain = simulate(stepper, system, y0, 0.02, steps), plainly(stepper, system, y0, 0.02, steps)
    assert body_run.applies(stepper, system) == (not any(hasattr(e, "at") for e in system.effects))
    assert np.allclose(run.y, plain.y, rtol=1e-13, atol=1e-13) and run.counters == plain.counters
    assert np.array_equal(run.t, plain.t)


@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("kinds", ["diagonal", "spheres", "one sphere", "one full"])
def test_the_numbers_of_an_inertia_that_are_zero_are_left_out(stepper, kinds):
    """The first of three bodies has another inertia than the others: indices, diagonals and full tensors."""
    turned = rotation.to_matrix(rotation.as_unit("q", [1.0, 0.4, -0.3, 0.2]))
    full, round_, long = turned * [1.0, 1.4, 1.8] @ turned.T, 1.3 * np.eye(3), np.diag([1.0, 1.5, 2.0])
    inertia = {"diagonal": [long] * 3, "spheres": [round_] * 3, "one sphere": [round_, long, long],
               "one full": [full, long, round_]}[kinds]  # fmt: skip
    system = RigidBodies(
        [1.0, 2.0, 0.7], inertia, [Gravity([0.1, 0.0, -9.81]), Drag([0.1, 0.2, 0.3]), AngularDrag(0.2)]
    )
    y0 = system.state(
        RNG.normal(size=(3, 3)), RNG.normal(size=(3, 4)), RNG.normal(size=(3, 3)), RNG.normal(size=(3, 3))
    )
    run, plain = simulate(stepper, system, y0, 0.02, 30), plainly(stepper, system, y0, 0.02, 30)
    assert np.allclose(run.y, plain.y, rtol=1e-13, atol=1e-13)


def test_products_with_zeros_are_not_made():
    rows = InertiaRows(np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0], [3.0, 2.0, 1.5, 0.0, 0.5, 0.0]]))
    w = RNG.normal(size=(3, 2))
    assert len(rows._others) == 1
    six = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0], [3.0, 2.0, 1.5, 0.0, 0.5, 0.0]])
    assert np.allclose(rows.times(w), angular_momentum(six, w.T).T)


def test_gradients_of_a_run_are_those_of_the_plain_path():
    system, y0 = generic(catalog.BODY_EFFECTS[0])
    run, plain = simulate(SymplecticEuler(), system, y0, 0.01, 20), plainly(SymplecticEuler(), system, y0, 0.01, 20)
    dJdy = RNG.normal(size=run.y.shape)
    one, two = adjoint(run, dJdy), adjoint(plain, dJdy)
    assert np.allclose(one.y0, two.y0, rtol=1e-11, atol=1e-11)
    assert np.allclose(one.theta, two.theta, rtol=1e-11, atol=1e-11 * np.abs(two.theta).max())


def test_a_start_of_another_norm_is_kept_as_given_and_turns_alike():
    system, y0 = generic(catalog.BODY_EFFECTS[0])
    longer = y0.copy()
    system.frame.turns(longer[: system.width])[:] *= [[2.0], [0.3], [1.0], [7.0]]
    one, two = simulate(SymplecticEuler(), system, y0, 0.01, 5), simulate(SymplecticEuler(), system, longer, 0.01, 5)
    assert np.array_equal(two.y[0], longer) and np.allclose(one.y[1:], two.y[1:], rtol=1e-14, atol=1e-15)


def test_a_run_that_overflows_ends_with_its_last_good_state():
    system, y0 = generic_bodies((AngularDrag(400.0), Drag(400.0, wind=[1.0, 0, 0])), np.random.default_rng(1))
    run, plain = record(ForwardEuler(), system, y0, 1.0, 400), None
    with np.errstate(all="ignore"):
        plain = plainly(ForwardEuler(), system, y0, 1.0, 400)
    assert run.status is plain.status is Status.NOT_FINITE and len(run.t) == len(plain.t) < 400
    assert np.isfinite(run.y).all() and run.counters == plain.counters


def test_where_it_does_not_apply():
    system, y0 = generic(catalog.BODY_EFFECTS[0])
    assert not body_run.applies(RK4(), system) and not body_run.applies(BackwardEuler(), system)
    assert not body_run.applies(SymplecticEuler(), compose(system, System([1.0])))
    assert not body_run.applies(SymplecticEuler(), System([1.0]))

    class Own(SymplecticEuler):
        def step(self, system, t, y0, h):
            return super().step(system, t, y0, h)

    assert not body_run.applies(Own(), system)
    assert simulate(SymplecticEuler(), system, y0, 0.01, 3, keep="steps").steps is not None


def test_a_place_is_reached_only_where_a_force_asks(monkeypatch):
    """The gyroscopic torque does not: free bodies are turned once a step, by velocity Verlet as well."""
    reached, right = [], body_run.BodyRun.reached
    monkeypatch.setattr(body_run.BodyRun, "reached", lambda self, *a: reached.append(1) or right(self, *a))
    for stepper, extra, count in (
        (VelocityVerlet(), (), 10),
        (SymplecticEuler(), (AngularDrag(0.1),), 10),
        (VelocityVerlet(), (Drag(0.1),), 20),
    ):
        system, y0 = generic_bodies(extra, np.random.default_rng(0))
        reached.clear()
        simulate(stepper, system, y0, 0.01, 10)
        assert len(reached) == count, (stepper, extra)


def test_attitudes_are_turned_once_a_step_however_many_they_are(monkeypatch):
    counts = []
    for bodies in (2, 200):
        calls, right = [], rotation.product
        monkeypatch.setattr(rotation, "product", lambda p, q, right=right, calls=calls: calls.append(1) or right(p, q))
        system, y0 = generic_bodies((Gravity([0, 0, -9.81]),), np.random.default_rng(0), bodies)
        simulate(SymplecticEuler(), system, y0, 0.01, 7)
        counts.append(len(calls))
        monkeypatch.undo()
    assert counts == [7, 7]


def test_a_wrong_force_shape_is_named():
    class Bad:
        name = "bad"

        def bind_bodies(self, layout):
            return self

        def force(self, t, q, v):
            return np.zeros(3)

    system = RigidBodies([1.0], np.eye(3), [Bad()])
    with pytest.raises(ValueError, match=r"force of 'bad' must return shape \(6,\); got \(3,\)"):
        simulate(SymplecticEuler(), system, system.state([0, 0, 0]), 0.01, 2)


def test_wrong_rows_are_red(monkeypatch):
    right = GyroscopicRows.add_force

    def wrong(self, t, place, v, out):
        right(self, t, place, v, out)
        out[3:] *= 1 + 1e-9

    monkeypatch.setattr(GyroscopicRows, "add_force", wrong)
    failed = [check for check in check_body_effect(catalog.BODY_EFFECTS[0]) if not check.passed]
    assert [check.statement for check in failed] == ["rows = force"]


def test_the_plan_says_which_effects_act_in_place():
    system, y0 = generic_bodies((Gravity([0, 0, -9.81]), AngularDrag(0.1)), np.random.default_rng(0))
    lines = {line.stage: line.why for line in plan(system, SymplecticEuler(), y0, 0.01).lines if line.state == "on"}
    assert lines["gravity"].endswith("in place") and lines["gyroscopic"].endswith("in place")
    assert lines["angular_drag"].endswith("by its force")
