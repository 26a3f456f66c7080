"""Steppers against closed forms: amplification, stability, equivalence, and the rule's own coefficients."""

from dataclasses import dataclass

import numpy as np
import pytest

from dsim import Flow, System, simulate
from dsim.effects import Drag, Field, Gravity, Springs
from dsim.simulation import record
from dsim.solve import Status
from dsim.steppers import (
    BDF2,
    RK4,
    BackwardEuler,
    ForwardEuler,
    ImplicitMidpoint,
    ImplicitRuleStepper,
    RuleStepper,
    SymplecticEuler,
    Trapezoidal,
    TwoStepBackwardEuler,
    VelocityVerlet,
)
from dsim.steppers import tableau as symbols


def oscillator(k):
    """A unit mass on a line: x'' = -k x, with its exact derivative and energy."""
    return System([1.0], Field(lambda x: -k * x, lambda x: np.full((1, 1, 1), -k), lambda x: k * x[:, 0] ** 2 / 2), 1)


AMPLIFICATION = {
    ForwardEuler: lambda z: 1 + z,
    BackwardEuler: lambda z: 1 / (1 - z),
    ImplicitMidpoint: lambda z: (1 + z / 2) / (1 - z / 2),
    Trapezoidal: lambda z: (1 + z / 2) / (1 - z / 2),
    RK4: lambda z: 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
}


@pytest.mark.parametrize("method", AMPLIFICATION)
def test_a_step_of_a_linear_flow_is_the_stability_function(method):
    """y' = lambda y, written in real numbers: R(h lambda)."""
    matrix = np.array([[-0.7, -2.0], [2.0, -0.7]])
    flow = Flow(lambda t, y: matrix @ y, 2, lambda t, y: matrix)
    y = simulate(method(), flow, [1.0, 0.5], h=0.3, steps=3).y
    factor = AMPLIFICATION[method](0.3 * (-0.7 + 2j))
    expected = (1.0 + 0.5j) * factor ** np.arange(4)
    assert np.allclose(y[:, 0] + 1j * y[:, 1], expected, rtol=1e-13, atol=1e-14)


def test_bdf2_follows_its_recurrence_from_the_theta_step():
    z = -0.4
    flow = Flow(lambda t, y: z * y, 1, lambda t, y: np.array([[z]]))
    y = simulate(BDF2(), flow, [1.0], h=1.0, steps=6).y[:, 0]
    assert y[1] == pytest.approx((1 + z / 3) / (1 - 2 * z / 3), rel=1e-14)
    assert np.allclose(y[2:], (4 * y[1:-1] - y[:-2]) / 3 / (1 - 2 * z / 3), rtol=1e-13)


def test_backward_euler_damps_a_stiff_spring_by_its_exact_factor():
    """Hard case 1: k = 1e8, h = 0.01; the energy falls by 1/(1 + h^2 w^2) a step."""
    h, k = 0.01, 1e8
    run = simulate(BackwardEuler(), oscillator(k), [1.0, 0.0], h, 20)
    energy = np.array([0.5 * v**2 + 0.5 * k * x**2 for x, v in run.y])
    assert np.allclose(energy[1:] / energy[:-1] * (1 + h**2 * k), 1, rtol=1e-10)


def test_forward_euler_overflows_on_the_stiff_spring_and_says_when():
    """x_n = Re (1 + 100 i)^n.  The force k x overflows first, at |x_151| = 1e302: step 152 is the one that fails."""
    run = record(ForwardEuler(), oscillator(1e8), [1.0, 0.0], 0.01, 1000)
    assert run.status is Status.NOT_FINITE and len(run.t) - 1 == 151 and np.isfinite(run.y).all()


def test_symplectic_euler_at_the_edge_of_stability():
    """Hard case 2: hw = 1.99 stays below 1/sqrt(1-(hw/2)^2), hw = 2.01 overflows; the modified energy is constant."""
    w, h = 1.0, 1.99
    x, v = simulate(SymplecticEuler(), oscillator(w**2), [1.0, 0.0], h, 10_000).y.T
    assert np.abs(x).max() == pytest.approx(10.0125, abs=1e-3)
    modified = v**2 / 2 + w**2 * x**2 / 2 - h * w**2 * x * v / 2
    assert np.abs(modified - modified[0]).max() <= 1e-12 * w**2 / 2
    assert record(SymplecticEuler(), oscillator(1.0), [1.0, 0.0], 2.01, 10_000).status is Status.NOT_FINITE


@pytest.mark.parametrize("method", [ImplicitMidpoint, Trapezoidal])
def test_energy_of_a_linear_oscillator_is_kept(method):
    run = simulate(method(), oscillator(100.0), [1.0, 0.0], 0.3, 200)
    energy = run.y[:, 1] ** 2 / 2 + 50 * run.y[:, 0] ** 2
    assert np.allclose(energy, 50, rtol=1e-10)


def net(**options):
    effects = (Gravity([0, -9.81]), Drag(0.3, wind=[1.0, 0]), Springs([(0, 1), (1, 2), (0, 2)], 1.0, 200.0))
    return System([1.0, 0.7, 1.3], effects, dimension=2, **options)


START = np.array([0, 0, 1.1, 0, 0.4, -0.9, 0, 0, 0.3, -0.2, 0.5, 0.1])


def test_two_steps_are_backward_euler():
    one, two = (simulate(m(tol=1e-13), net(fixed=[0]), START, 0.02, 50) for m in (BackwardEuler, TwoStepBackwardEuler))
    assert np.allclose(one.y, two.y, rtol=0, atol=1e-10)


def test_verlet_keeps_order_two_with_drag_where_the_half_step_velocity_would_not():
    @dataclass(frozen=True)
    class HalfStep(RuleStepper):
        order = 1
        form = 2

        def rule(self, q, v, a, t, h):
            half = v[0] + h / 2 * a(t, q[0], v[0])
            q1 = q[0] + h * half
            return q1, half + h / 2 * a(t + h, q1, half)

    system = System([1.0], Drag(1.0), 1)

    def error(method, steps):
        return abs(simulate(method, system, [0.0, 1.0], 1 / steps, steps).v[-1, 0] - np.exp(-1))

    assert error(VelocityVerlet(), 50) / error(VelocityVerlet(), 100) == pytest.approx(4, abs=0.2)
    assert error(HalfStep(), 50) / error(HalfStep(), 100) == pytest.approx(2, abs=0.1)


def test_pinned_points_stay_whatever_their_velocity_says():
    y0 = START.copy()
    y0[6:8] = 5.0
    for stepper in (ForwardEuler(), BackwardEuler(), BDF2(), TwoStepBackwardEuler(), VelocityVerlet(), RK4()):
        run = simulate(stepper, net(fixed=[0]), y0, 0.01, 5)
        assert (run.q[:, :2] == START[:2]).all() and (run.v[1:, :2] == 0).all()


@pytest.mark.parametrize("method", [BackwardEuler, ImplicitMidpoint, TwoStepBackwardEuler])
def test_energy_descent_finds_the_same_step(method):
    effects = (Gravity([0, -9.81]), Springs([(0, 1), (1, 2), (0, 2)], 1.0, 2e4))
    system = System([1.0, 0.7, 1.3], effects, dimension=2, fixed=[0])
    plain, descent = (simulate(method(globalize=g), system, START, 0.01, 5) for g in ("line_search", "energy"))
    assert np.allclose(plain.y, descent.y, rtol=0, atol=1e-9)


def test_descent_gets_through_where_a_compressed_net_stops_newton():
    """A chain squeezed to a tenth: the matrix is indefinite, and plain Newton fails within its iterations."""
    n = 12
    x = np.stack([0.1 * np.arange(n), 1e-3 * np.sin(np.arange(n))], axis=1)
    system = System(np.ones(n), Springs([(i, i + 1) for i in range(n - 1)], 1.0, 1e5), dimension=2, fixed=[0])
    y0 = np.concatenate([x.ravel(), np.zeros(2 * n)])
    run = simulate(BackwardEuler(globalize="energy", max_iterations=200), system, y0, 0.1, 3)
    assert run.status is Status.CONVERGED
    assert system.energy(0.0, run.y[-1]) < system.energy(0.0, y0)


# Rules and their coefficients


def test_coefficients_are_read_off_the_rule():
    """Backward Euler, eliminated: the stage sits at (q0 + h v0 + h^2 k, v0 + h k), whence M - h D - h^2 K."""
    h = 0.1
    q, v, k = ("y", 0, 0), ("y", 0, 1), ("k", 0, 0)
    table = symbols.eliminate(symbols.record(BackwardEuler().rule, 1, 2, h))
    assert table.stages[0].offset == h
    assert table.stages[0].arguments == ({q: 1.0, v: h, k: h * h}, {v: 1.0, k: h})


def test_rk4_in_nystrom_form():
    table = symbols.eliminate(symbols.record(RK4().rule, 1, 2, 1.0))
    positions, velocities = table.outcome
    k = [("k", s, 0) for s in range(4)]
    assert [velocities.get(s, 0) for s in k] == pytest.approx([1 / 6, 1 / 3, 1 / 3, 1 / 6])
    assert [positions.get(s, 0) for s in k] == pytest.approx([1 / 6, 1 / 6, 1 / 6, 0])


def test_a_rule_that_needs_a_later_rate_is_refused():
    @dataclass(frozen=True)
    class FullyImplicit(ImplicitRuleStepper):
        order = 2

        def rule(self, y, phi, t, h):
            early = phi(t, y[1])
            return y[0] + h / 2 * (early + phi(t + h, y[1]))

    with pytest.raises(ValueError, match="diagonally implicit"):
        simulate(FullyImplicit(), net(), START, 0.01, 1)


def test_a_rule_without_a_formula_says_so():
    with pytest.raises(NotImplementedError, match="RuleStepper must state its rule"):
        RuleStepper().step(net(), 0.0, START, 0.1)


def test_states_and_rates_do_not_mix():
    with pytest.raises(TypeError, match="states to states"):
        symbols.Form({("y", 0, 0): 1.0}) + symbols.Form({}, {})


# Counts


def test_an_explicit_run_asks_for_forces_alone():
    calls = {"dq": 0, "dv": 0}

    class Watched(Drag):
        def dv(self, t, q, v):
            calls["dv"] += 1
            return super().dv(t, q, v)

    system = System([1.0], Watched(1.0), 1)
    for method, forces in ((ForwardEuler, 1), (SymplecticEuler, 1), (VelocityVerlet, 2), (RK4, 4)):
        counters = simulate(method(), system, [0.0, 1.0], 0.1, 7).counters
        assert counters.forces == 7 * forces and counters.jacobians == counters.factorizations == 0
    assert calls["dv"] == 0


def test_an_implicit_run_factorizes_once_an_iteration():
    counters = simulate(BackwardEuler(), net(), START, 0.01, 10).counters
    assert counters.factorizations == counters.jacobians == counters.newton_iterations
    assert 20 <= counters.newton_iterations <= 50
    assert counters.forces == counters.newton_iterations + 10
