"""Bodies with a known motion: closed forms against integrators, orders of states and gradients, what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dsim import catalog
from dsim.arrays import rotation
from dsim.report.accuracy import methods
from dsim.steppers import RK4, RKMK4, ImplicitMidpoint, SymplecticEuler
from dsim.studies import body_problems
from dsim.studies.body_problems import FreeTop, HeavyTop, free_top, heavy_top, world_momentum
from dsim.studies.problems import Problem, adjoint_equation, solution
from dsim.studies.reference import LSODA, Reference
from dsim.studies.work_precision import Sweep, measure, work_precision

BOTH = [free_top, heavy_top]


@pytest.mark.parametrize("build", BOTH)
def test_closed_forms_agree_with_an_integrator(build):
    problem = build()
    numerical = solution(problem, Reference("DOP853", 1e-10))
    for t in np.linspace(0, problem.duration, 25):
        assert np.abs(problem.exact(t) - numerical(t)).max() < 2e-8  # the sign of q too: it never jumps


@pytest.mark.parametrize("spin", [(0.6, 0.4, 1.0), (0.6, -0.4, -1.0), (-0.01, 1.0, 0.9), (0.5, 0.0, -2.0)])
def test_free_tops_of_any_start(spin):
    """Euler's equations and qdot = q (x) (0, w) / 2, written here."""
    moments = np.array([1.0, 2.0, 3.0])

    def flow(t, y):
        q, w = y[None, :4], y[4:]
        turn = 0.5 * rotation.product(q, np.concatenate([[0.0], w])[None])[0]
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    top = FreeTop(tuple(moments), spin)
    y = solve_ivp(flow, (0, 9.0), [1.0, 0, 0, 0, *spin], "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    assert np.abs(top.spins(9.0) - y[4:]).max() < 1e-8
    assert np.abs(top.attitude(9.0) - y[:4]).max() < 1e-8


def test_a_top_about_another_axis_is_refused():
    with pytest.raises(ValueError, match=r"\|L\|\^2 > 2 E I2"):
        FreeTop((1.0, 2.0, 3.0), (1.0, 0.4, 0.1)).spins(0.0)
    with pytest.raises(ValueError, match="moments must rise"):
        FreeTop((3.0, 2.0, 1.0), (0.1, 0.4, 1.0)).spins(0.0)
    with pytest.raises(ValueError, match="spin must be off the axis"):
        FreeTop((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)).spins(0.0)
    for tilt in (0.0, np.pi, np.nan):
        with pytest.raises(ValueError, match="tilt must lie between 0 and pi rad"):
            HeavyTop(tilt)


def test_a_symmetric_top_precesses_evenly():
    """I1 -> I2: w turns about the axis with (I3 - I1)/I1 w3, and the axis about L with |L|/I1."""
    top = FreeTop((1.0, 1.0 + 1e-9, 2.0), (0.3, 0.0, 1.5))
    t = 2.3
    expected = [0.3 * np.cos(1.5 * t), 0.3 * np.sin(1.5 * t), 1.5]
    assert np.abs(top.spins(t) - expected).max() < 1e-7
    L = np.array([0.3, 0.0, 3.0])
    steady = rotation.product(
        rotation.exponential(L[None] * t), rotation.exponential(np.array([[0.0, 0.0, -1.5 * t]]))
    )[0]
    assert np.abs(top.attitude(t) - steady).max() < 1e-7


def test_a_heavy_top_in_steady_precession_does_not_nod():
    slow = (2.5 - np.sqrt(2.5**2 - 4 * np.cos(0.5))) / (2 * np.cos(0.5))  # W^2 cos - I3 w3 W + 1 = 0
    top = HeavyTop(0.5, 5.0, slow * (1 + 1e-9))
    axis = rotation.rotate(top.state(3.0)[None, 3:7], np.array([0.0, 0.0, 1.0]))[0]
    assert np.arccos(axis[2]) == pytest.approx(0.5, abs=1e-7)
    assert np.arctan2(axis[1], axis[0]) == pytest.approx(3.0 * slow, abs=1e-6)


@pytest.mark.parametrize("build", [free_top, pytest.param(heavy_top, marks=pytest.mark.slow)])
def test_the_adjoint_equation_is_the_derivative(build):
    """By all 13 numbers of the start, q among them at any norm."""
    problem = build()

    def final(y0):
        moved = replace(problem, y0=y0, exact=None)
        return problem.objective(solution(moved, Reference("DOP853", 1e-11))(problem.duration))

    gradient = problem.truth().gradient
    rng = np.random.default_rng(2)
    for _ in range(2):
        u = 1e-5 * rng.normal(size=13)
        u[3:7] -= (u[3:7] @ problem.y0[3:7]) * problem.y0[3:7]  # along the sphere: the flow does not ask for |q|
        difference = final(_unit(problem.y0 + u)) - final(_unit(problem.y0 - u))
        assert 2 * gradient @ u == pytest.approx(difference, rel=1e-5)
    again = adjoint_equation(problem, LSODA, problem.exact(problem.duration))
    assert problem.gradient_error(again, gradient) < 1e-7


def _unit(y):
    y = y.copy()
    y[3:7] /= np.linalg.norm(y[3:7])
    return y


ORDERS = {"ForwardEuler": 1, "SymplecticEuler": 1, "NormalisedEuler": 1, "BackwardEuler": 1, "ImplicitMidpoint": 2,
          "Trapezoidal": 2, "VelocityVerlet": 2, "RK4": 4, "RKMK4": 4}  # fmt: skip


QUICK = ("SymplecticEuler", "ImplicitMidpoint", "RKMK4")
BY_SPEED = [pytest.param(s, marks=[] if type(s).__name__ in QUICK else pytest.mark.slow) for s in catalog.BODY_STEPPERS]


@pytest.mark.parametrize("stepper", BY_SPEED, ids=lambda s: type(s).__name__)
def test_orders_of_states_and_gradients(stepper):
    order = ORDERS[type(stepper).__name__]
    coarse, fine = (measure(free_top(), stepper, n) for n in {1: (64, 128), 2: (32, 64), 4: (128, 256)}[order])
    for quantity in ("state", "gradient"):
        observed = np.log2(coarse.error_of(quantity) / fine.error_of(quantity))
        assert observed == pytest.approx(order, abs=0.5), quantity


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [s for s in catalog.BODY_STEPPERS if type(s).__name__ in (*QUICK, "RK4")])
def test_orders_on_the_heavy_top(stepper):
    order = ORDERS[type(stepper).__name__]
    steps = 512 if order == 1 else 256  # Euler's steps are long to settle
    coarse, fine = (measure(heavy_top(), stepper, n) for n in (steps, 2 * steps))
    for quantity in ("state", "gradient"):
        observed = np.log2(coarse.error_of(quantity) / fine.error_of(quantity))
        assert observed == pytest.approx(order, abs=0.5), quantity


def test_what_is_kept_and_what_is_not():
    """Implicit midpoint with Cayley's map keeps the energy and L in the world; symplectic Euler neither."""
    kept, lost = (
        measure(free_top(), stepper, 256).drift for stepper in (ImplicitMidpoint(tol=1e-13), SymplecticEuler())
    )
    assert kept < 1e-12 and lost > 1e-2
    problem = free_top()
    for t in (0.0, 3.0):
        turned = world_momentum(problem.system, problem.exact(t))[0]
        assert np.abs(turned - np.array([0.6, 0.8, 3.0])).max() < 1e-13


def test_a_wrong_truth_shows_as_a_plateau():
    good = free_top()
    bad = replace(good, exact=lambda t: good.exact(t * (1 + 1e-3)))
    assert measure(good, RK4(), 512).error < 1e-8 and measure(bad, RK4(), 512).error > 1e-4


def test_a_quaternion_and_its_negative_are_one_attitude():
    problem = free_top()
    y = np.stack([problem.exact(t) for t in (1.0, 2.0)])
    negative = y.copy()
    negative[:, 3:7] *= -1
    assert np.abs(problem._apart(negative, y)).max() == 0.0


def test_the_study_takes_the_steppers_that_turn():
    problem = free_top()
    chosen = methods(problem)
    assert (
        chosen[: len(catalog.BODY_STEPPERS)] == catalog.BODY_STEPPERS and len(chosen) == len(catalog.BODY_STEPPERS) + 2
    )
    study = work_precision(problem, [RKMK4(), RK4(), ImplicitMidpoint()], Sweep(levels=3, costly=1, rounds=0))
    assert study.cheapest(1e-4).method in ("RK4", "RKMK4") and isinstance(problem, Problem)
    assert {build for build in catalog.PROBLEMS} >= {body_problems.free_top, body_problems.heavy_top}
