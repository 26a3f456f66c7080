"""Explicit runs on coordinate rows: the same states and gradients as the plain path, and nothing evaluated in vain."""

import numpy as np
import pytest

from dsim import System, adjoint, catalog, plan, simulate
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs, rows
from dsim.effects.rows import PlainRows
from dsim.simulation import _stepwise, record
from dsim.solve import Status
from dsim.steppers import BackwardEuler, ForwardEuler, SymplecticEuler
from dsim.steppers import explicit_run as fast

EXPLICIT = [s for s in catalog.STEPPERS if not s.implicit]


def net(dimension, seed=0):
    rng = np.random.default_rng(seed)
    points, pairs = 6, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (0, 3), (1, 4)]
    effects = (
        Gravity(rng.normal(size=dimension)),
        Drag(rng.uniform(0.1, 1.0, points), wind=rng.normal(size=dimension)),
        Drag(0.3, name="still"),
        Drag(0.2, wind=lambda t, x: np.sin(x + t), name="gusts"),
        Springs(pairs, rng.uniform(0.5, 2.0, 8), rng.uniform(5.0, 30.0, 8)),
        SpringDamping(pairs, 0.2),
        Field(lambda x: -x),
    )
    system = System(rng.uniform(0.5, 2.0, points), effects, dimension, fixed=(2, 5))
    return system, rng.normal(size=system.size)


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("stepper", EXPLICIT, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("keep", ["states", "steps"])
def test_rows_and_plain_path_agree(stepper, dimension, keep):
    system, y0 = net(dimension)
    run = simulate(stepper, system, y0, 0.01, 30, keep=keep)
    assert run.run is not None and (run.run.tape is not None) == (keep == "steps")
    y = np.empty_like(run.y)
    y[0] = y0
    plain = _stepwise(stepper, system, y, 0.01, "steps")
    assert np.allclose(run.y, plain.y, rtol=1e-13, atol=1e-13) and run.counters == plain.counters
    dJdy = np.random.default_rng(1).normal(size=run.y.shape)
    one, two = adjoint(run, dJdy), adjoint(plain, dJdy)
    assert np.allclose(one.y0, two.y0, rtol=1e-11, atol=1e-11)
    assert np.allclose(one.theta, two.theta, rtol=1e-11, atol=1e-11 * np.abs(two.theta).max())


@pytest.mark.parametrize("example", catalog.EFFECTS, ids=lambda e: e.name)
def test_rows_of_an_effect_are_its_force_and_vjp(example):
    """In place and added to what is there already; an effect without rows is wrapped."""
    rng = np.random.default_rng(3)
    system = System(rng.uniform(0.5, 2.0, 5), example.make(rng, 5, 3), 3)
    effect = system.effects[0]
    made = effect.rows() if getattr(effect, "rows", None) is not None else PlainRows(effect)
    x, v, w, out = rng.normal(size=(4, 3, 5))
    flat = [a.T.ravel() for a in (x, v, w)]
    saved, before = tuple(np.empty(shape) for shape in made.saves), out.copy()
    made.add_force(0.03, x, v, out, saved)
    assert np.allclose((out - before).T.ravel(), effect.force(0.03, *flat[:2]), rtol=1e-13, atol=1e-13)
    if hasattr(made, "constant"):
        assert np.array_equal(out - before, (before + made.constant) - before)
    theta_bar, expected = np.zeros((2, system.parameter_count))
    by_q, by_v = system.vjp(0.03, *flat, expected)
    views = [theta_bar[p.place].reshape(p.shape) for p in system.layout[0]]
    pulled = np.zeros((2, 3, 5))
    made.add_vjp(0.03, (x, v), w, (*pulled, *views), saved)
    for found, true in ((pulled[0].T.ravel(), by_q), (pulled[1].T.ravel(), by_v), (theta_bar, expected)):
        assert np.allclose(found, true, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_both_scatters_agree(dimension):
    rng = np.random.default_rng(2)
    pairs, shape = rng.integers(0, 7, (20, 2)), (dimension, 7)
    values = rng.normal(size=(dimension, 20))
    expected = np.zeros(shape)
    for e, (i, j) in enumerate(pairs):
        expected[:, i] += values[:, e]
        expected[:, j] -= values[:, e]
    for make in (rows._sparse_ends, rows._counted_ends):
        assert np.allclose(make(pairs, shape)(values), expected, rtol=0, atol=1e-14)


def test_many_springs_take_the_sparse_scatter(monkeypatch):
    """The other scatter, with equal results."""
    system, y0 = net(3)
    plain = simulate(SymplecticEuler(), system, y0, 0.01, 20).y
    monkeypatch.setattr(rows, "FEW", 0)
    monkeypatch.setattr(rows, "_counted_ends", None)
    assert np.allclose(simulate(SymplecticEuler(), system, y0, 0.01, 20).y, plain, rtol=0, atol=1e-12)


def test_coincident_ends_feel_no_force_on_either_path():
    system = System([1.0, 1.0], Springs([(0, 1)], 1.0, 10.0), 2)
    run = simulate(SymplecticEuler(), system, np.zeros(8), 0.1, 3, keep="steps")
    assert (run.y == 0).all() and np.isfinite(adjoint(run, np.ones_like(run.y)).theta).all()


@pytest.mark.parametrize("steps", [151, 152, 200, 1000])
def test_the_step_that_overflows_is_named(steps):
    system = System([1.0], Field(lambda x: -1e8 * x), 1)
    run = record(ForwardEuler(), system, [1.0, 0.0], 0.01, steps)
    assert len(run.t) - 1 == 151 and (run.status is Status.CONVERGED) == (steps == 151)
    assert np.isfinite(run.y).all() and run.counters.forces == min(steps, 152)


def test_the_last_state_and_its_load_need_no_rows_of_the_others():
    """`last` is y[-1], the load of the last state alone is a load of zeros before it; also without a step."""
    system, y0 = net(2)
    for steps in (0, 7):
        for stepper in (SymplecticEuler(), BackwardEuler()):
            run = simulate(stepper, system, y0, 0.01, steps)
            assert np.array_equal(run.last, run.y[-1])
            load = np.zeros_like(run.y)
            load[-1] = np.random.default_rng(4).normal(size=system.size)
            full, short = adjoint(run, load), adjoint(run, load[-1])
            assert np.array_equal(full.y0, short.y0) and np.array_equal(full.theta, short.theta)


def test_the_bytes_held_for_the_way_back_are_counted():
    system, y0 = net(2)
    states, tape = (simulate(SymplecticEuler(), system, y0, 0.01, 20, keep=keep) for keep in ("states", "steps"))
    assert states.tape_bytes == states.y.nbytes
    edges, unit = 8, 8  # springs; bytes a number
    assert tape.tape_bytes - states.tape_bytes == 20 * unit * (edges * (2 + 1) + 2 * 6)  # edges, 1/l, rates
    implicit = simulate(BackwardEuler(), system, y0, 0.01, 20, keep="steps")
    assert implicit.tape_bytes == implicit.y.nbytes + 20 * unit * system.n


def test_a_tape_beyond_its_budget_is_not_kept_and_the_gradient_is_the_same(monkeypatch):
    system, y0 = net(2)
    runs = [simulate(SymplecticEuler(), system, y0, 0.01, 20, keep="steps")]
    monkeypatch.setattr(fast, "TAPE_BYTES", 10)
    runs.append(simulate(SymplecticEuler(), system, y0, 0.01, 20, keep="steps"))
    assert runs[0].run.tape is not None and runs[1].run.tape is None
    gradients = [adjoint(run, np.ones_like(run.y)).theta for run in runs]
    assert np.array_equal(*gradients)


def test_an_explicit_run_and_its_gradient_never_ask_for_a_matrix(monkeypatch):
    def forbidden(*arguments):
        raise AssertionError("a matrix was asked for")

    for effect in (Gravity, Drag, Springs, SpringDamping, Field):
        for capability in ("dq", "dv", "dtheta"):
            if hasattr(effect, capability):
                monkeypatch.setattr(effect, capability, forbidden)
    system, y0 = net(3)
    run = simulate(SymplecticEuler(), system, y0, 0.01, 5)
    assert np.isfinite(adjoint(run, np.ones_like(run.y)).theta).all()


def test_a_run_ends_at_the_step_that_fails():
    """Not a step later: counts are those of the plain path, and a force never sees what is not finite."""
    seen = []

    class Steep:
        name = "steep"

        def force(self, t, q, v):
            seen.append(np.isfinite(q).all() and np.isfinite(v).all())
            return -1e8 * q

    run = record(ForwardEuler(), System([1.0], Steep(), 1), [1.0, 0.0], 0.01, 1000)
    assert run.status is Status.NOT_FINITE and len(seen) == run.counters.forces == 152 and all(seen)


def test_a_system_with_a_force_of_its_own_is_obeyed():
    class Mirrored(System):
        def force(self, t, q, v):
            return -super().force(t, q, v)

    run = simulate(SymplecticEuler(), Mirrored([1.0], Gravity([-1.0]), 1), [0.0, 0.0], 0.1, 1)
    assert run.last[1] == pytest.approx(0.1)


def test_effects_with_discrete_choices_and_overridden_forces_take_the_plain_path():
    class Heavy(Gravity):
        def force(self, t, q, v):
            return 2 * super().force(t, q, v)

    pushes = np.random.default_rng(0).normal(size=(5, 2, 1))
    system = System([1.0, 2.0], [Heavy([-1.0]), Actuation(pushes, 0.1)], 1)
    y0 = np.zeros(4)
    run = simulate(SymplecticEuler(), system, y0, 0.1, 5)
    y = np.empty((6, 4))
    y[0] = y0
    assert run.run is None and np.array_equal(run.y, _stepwise(SymplecticEuler(), system, y, 0.1, "states").y)
    heavy = System([1.0], Heavy([-1.0]), 1)
    assert simulate(SymplecticEuler(), heavy, [0.0, 0.0], 0.1, 1).last[1] == pytest.approx(-0.2)
    assert "by its force" in str(plan(heavy, SymplecticEuler(), [0.0, 0.0], 0.1))
