"""Hessian-vector products by tangent-over-adjoint, Gauss-Newton products, and the optimisers that use them."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.optimize
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg

from dsim import catalog, scenes
from dsim.arrays.checks import Array
from dsim.arrays.differences import change_of_jacobian, change_of_slopes, slope
from dsim.arrays.scatter import diagonal
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.gradients import (
    Linearizations,
    ReducedObjective,
    Residuals,
    Variables,
    adjoint,
    gauss_newton_product,
    hessian_product,
    jacobian_product,
    jacobian_transposed,
)
from dsim.simulation import record, simulate
from dsim.solve.linear import DenseFactor
from dsim.steppers import BackwardEuler, ForwardEuler, ImplicitMidpoint, RuleStepper, SymplecticEuler
from dsim.steppers.rule import RuleLinearization
from dsim.studies.derivatives import curvature_deviation, directional
from dsim.system import Flow, System

H, STEPS = 0.02, 2  # both steps of a two-step method


def breeze(t: float, x: Array) -> Array:
    return np.roll(np.sin(x + t), 1, axis=1)


def cubic(x: Array) -> Array:
    return -(x**3)


def cubic_jacobian(x: Array) -> Array:
    return np.einsum("ni,ij->nij", -3 * x**2, np.eye(x.shape[1]))


def everything(steps: int = STEPS, seed: int = 0) -> tuple[System, Array]:
    """Four points in the plane, one pinned, with every effect; two of them have differenced second derivatives."""
    rng = np.random.default_rng(seed)
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2)]
    effects = (
        Gravity([0.3, -9.81]),
        Drag(rng.uniform(0.1, 0.5, 4), wind=[1.0, -0.5]),
        Drag(0.3, breeze, name="breeze"),
        Field(cubic, cubic_jacobian),
        Springs(pairs, rng.uniform(0.5, 1.2, 4), rng.uniform(20, 60, 4)),
        SpringDamping(pairs, rng.uniform(0.1, 0.6, 4)),
        Actuation(rng.normal(size=(steps, 4, 2)), h=H),
    )
    system = System(rng.uniform(0.5, 2.0, 4), effects, dimension=2, fixed=[0])
    return system, np.concatenate([rng.normal(size=8), 0.3 * rng.normal(size=8)])


@dataclass(frozen=True, eq=False)
class Bent:
    """J = sum over the path of w.y + y^3/6, + |theta|^2/2 y_N[2]: curved in the states, in theta and in both."""

    weights: Array
    final: bool = False

    def by_states(self, trajectory: Any) -> Array:
        load = self.weights + trajectory.y**2 / 2
        theta = trajectory.system.theta
        load[-1, 2] += theta @ theta / 2
        last: Array = load[-1]
        return last if self.final else load

    def by_theta(self, trajectory: Any) -> Array:
        value: Array = trajectory.system.theta * trajectory.last[2]
        return value

    def bends(self, trajectory: Any) -> Any:
        theta = trajectory.system.theta

        def change(dy: Array, dtheta: Array) -> Any:
            load = trajectory.y * dy
            load[-1, 2] += theta @ dtheta
            return load[-1] if self.final else load, dtheta * trajectory.last[2] + theta * dy[-1, 2]

        return change

    def gradient(self, trajectory: Any) -> Array:
        found = adjoint(trajectory, self.by_states(trajectory), self.by_theta(trajectory))
        return np.concatenate([found.y0, found.theta])

    def product(self, trajectory: Any, d: Array, linear: Any = None) -> Array:
        direction = tuple(np.split(d, [trajectory.system.size]))
        found = hessian_product(trajectory, self.by_states(trajectory), direction, self.bends(trajectory), linear)
        return np.concatenate([found.y0, found.theta])


def bent(system: Any, final: bool = False) -> Bent:
    return Bent(np.random.default_rng(1).normal(size=(STEPS + 1, system.size)), final)


def measured(stepper: Any, system: Any, y0: Array, objective: Bent, d: Array) -> Array:
    """H d by extrapolated differences of adjoint gradients."""

    def gradient(p: Array) -> Array:
        start, theta = np.split(p, [system.size])
        return objective.gradient(simulate(stepper, system.with_theta(theta), start, H, STEPS))

    there = np.concatenate([y0, system.theta])
    return directional(gradient, there, d[:, None])[:, 0]


def directions(system: Any, count: int = 2) -> Array:
    found: Array = np.random.default_rng(5).normal(size=(count, system.size + system.parameter_count))
    return found


def apart(found: Array, expected: Array) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("stepper", catalog.STEPPERS, ids=lambda s: type(s).__name__)
def test_product_is_the_difference_of_gradients(stepper: RuleStepper) -> None:
    """All effects, masses, the start and the explicit part at once; by blocks, so that none hides behind another."""
    system, y0 = everything()
    objective, d = bent(system), directions(system)[0]
    found = objective.product(simulate(stepper, system, y0, H, STEPS), d)
    expected = measured(stepper, system, y0, objective, d)
    blocks = np.split(expected, [system.size]), np.split(found, [system.size])
    assert apart(blocks[1][0], blocks[0][0]) < 1e-8
    parts = system.split(blocks[0][1]), system.split(blocks[1][1])
    for name in parts[0]:
        assert apart(parts[1][name], parts[0][name]) < 1e-8, name


@pytest.mark.parametrize("stepper", catalog.STEPPERS, ids=lambda s: type(s).__name__)
def test_hessian_is_symmetric(stepper: RuleStepper) -> None:
    """To round-off where every second derivative is a closed form."""
    system, y0 = everything()
    system = system.without("breeze", "field")
    assert system.curvature_differenced == ()
    trajectory = simulate(stepper, system, y0, H, STEPS)
    objective, (a, b) = bent(system, final=True), directions(system)
    forward, backward = a @ objective.product(trajectory, b), b @ objective.product(trajectory, a)
    assert abs(forward - backward) <= 1e-11 * abs(forward) + 1e-11


def test_objective_of_the_last_state() -> None:
    """(ny,) says the same as a path whose other rows are 0."""
    system, y0 = everything()
    trajectory = simulate(BackwardEuler(), system, y0, H, STEPS)
    final, d = bent(system, final=True), directions(system)[0]
    row, _ = final.bends(trajectory)(np.ones_like(trajectory.y), np.zeros(system.parameter_count))
    assert row.shape == (system.size,)
    found = final.product(trajectory, d)
    assert apart(found, measured(BackwardEuler(), system, y0, final, d)) < 1e-8
    load = np.zeros_like(trajectory.y)
    load[-1] = final.by_states(trajectory)

    def change(dy: Array, dtheta: Array) -> Any:
        rows = np.zeros_like(dy)
        rows[-1], explicit = final.bends(trajectory)(dy, dtheta)
        return rows, explicit

    same = hessian_product(trajectory, load, tuple(np.split(d, [system.size])), change)
    np.testing.assert_array_equal(np.append(same.y0, same.theta), found)


def test_closed_form_of_a_ball_with_drag() -> None:
    """Forward Euler: v_N = r^N v_0, r = 1 - h c / m, so the Hessian of v_N by (v_0, m, c) is known."""
    m, c, v, n, h = 2.0, 0.7, 1.3, 6, 0.1
    trajectory = simulate(ForwardEuler(), System([m], Drag(c), dimension=1), [0.4, v], h, n)
    r, slopes = 1 - h * c / m, np.array([h * c / m**2, -h / m])
    second = np.array([[-2 * h * c / m**3, h / m**2], [h / m**2, 0.0]])
    expected = np.zeros((4, 4))
    expected[1, 2:] = expected[2:, 1] = n * r ** (n - 1) * slopes
    expected[2:, 2:] = v * (n * (n - 1) * r ** (n - 2) * np.outer(slopes, slopes) + n * r ** (n - 1) * second)
    columns = []
    for d in np.eye(4):
        product = hessian_product(trajectory, [0.0, 1.0], (d[:2], d[2:]))
        columns.append(np.concatenate([product.y0, product.theta]))
    np.testing.assert_allclose(columns, expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("given", [True, False], ids=["jacobian", "differenced"])
def test_flow(given: bool) -> None:
    """dy/dt = A y with J = |y_N|^2 / 2: H = P^T P with P = (1 + h A)^N; and a curved flow against differences."""
    A = np.array([[0.0, 1.0], [-2.0, -0.3]])
    linear = Flow(lambda t, y: A @ y, 2, (lambda t, y: A) if given else None)
    trajectory = simulate(ForwardEuler(), linear, [1.0, 0.0], 0.1, 5)
    P = np.linalg.matrix_power(np.eye(2) + 0.1 * A, 5)
    rows = [hessian_product(trajectory, trajectory.last, (d, None), lambda dy, _: dy[-1]).y0 for d in np.eye(2)]
    np.testing.assert_allclose(rows, P.T @ P, rtol=1e-12 if given else 1e-8)

    def phi(t: float, y: Array) -> Array:
        return np.array([np.sin(y[1]) + t, -y[0] * y[1]])

    def slopes(t: float, y: Array) -> Array:
        return np.array([[0.0, np.cos(y[1])], [-y[1], -y[0]]])

    curved = Flow(phi, 2, slopes if given else None)

    def gradient(y0: Array) -> Array:
        run = simulate(ImplicitMidpoint(), curved, y0, 0.1, 5)
        return adjoint(run, run.y).y0

    y0, d = np.array([0.7, -0.4]), np.array([0.3, 1.1])
    run = simulate(ImplicitMidpoint(), curved, y0, 0.1, 5)
    found = hessian_product(run, run.y, (d, None), lambda dy, _: dy)
    assert curved.curvature_differenced == ("phi",) and found.theta.shape == (0,)
    assert apart(found.y0, directional(gradient, y0, d[:, None])[:, 0]) < 1e-8


def test_a_run_of_no_steps() -> None:
    system, y0 = everything()
    trajectory = simulate(BackwardEuler(), system, y0, H, 0)
    d = directions(system)[0][: system.size]
    product = hessian_product(trajectory, trajectory.last, (d, None), lambda dy, _: 3 * dy[-1])
    np.testing.assert_allclose(product.y0, 3 * d)
    assert not product.theta.any()


def test_whatever_the_run_kept() -> None:
    """Rates and factors kept with the steps, or made again from the states; dense and banded matrices."""
    cloth = scenes.cloth(n=7, h=0.01)
    d = np.random.default_rng(0).normal(size=cloth.system.size)
    found = []
    for keep in ("states", "steps", "factors"):
        run = simulate(BackwardEuler(tol=1e-13), cloth.system, cloth.y0, cloth.h, 2, keep)  # type: ignore[arg-type]
        found.append(hessian_product(run, run.y, (d, None), lambda dy, _: dy).y0)
    assert apart(found[1], found[0]) < 1e-8 and apart(found[2], found[0]) < 1e-8


# Effects


def test_capabilities_of_the_library_are_closed_forms() -> None:
    differenced = {e.name for e in catalog.EFFECTS if System(np.ones(5), _made(e), 2).curvature_differenced}
    assert differenced == {
        "drag, wind of place", "drag, wind differenced", "field", "field, differenced", "field, potential"}  # fmt: skip


def _made(example: Any, points: int = 5, dimension: int = 2) -> Any:
    return example.make(np.random.default_rng(1), points, dimension)


def _deviation(effect: Any) -> float:
    rng = np.random.default_rng(2)
    system = System(rng.uniform(0.5, 2, 5), effect, 2)
    q, v, w = rng.normal(size=(3, 10))
    return curvature_deviation(system, 0.03, (q, v), w, rng)


def _mutant(effect: Any, change: Any) -> Any:
    """The effect with its curvature changed."""
    kind = type(effect)
    body = {"curvature": lambda self, *a: tuple(map(change, kind.curvature(self, *a)))}
    twin = object.__new__(type("Mutant", (kind,), body))
    twin.__dict__.update(effect.__dict__)
    return twin


BENT = ("gravity", "drag", "drag per point", "drag, wind of place", "field", "springs", "spring damping")


@pytest.mark.parametrize("name", BENT)
def test_a_wrong_curvature_is_red(name: str) -> None:
    example = next(e for e in catalog.EFFECTS if e.name == name)
    for change in (lambda part: 1.01 * part, lambda part: -part, lambda part: 0.0 * part):
        assert _deviation(_mutant(_made(example), change)) > 1e-4
    assert _deviation(_mutant(_made(example), lambda part: part)) < 1e-8


class Duffing:
    """A user's effect: a nonlinear spring to the origin, f = -k q^3, with nothing but its Jacobians."""

    name = "duffing"
    parameters: tuple[str, ...] = ("stiffness",)

    def __init__(self, stiffness: float = 2.0) -> None:
        self.stiffness = np.array(stiffness)

    def force(self, t: float, q: Array, v: Array) -> Array:
        return -self.stiffness * q**3

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        return diagonal(-3 * self.stiffness * q**2)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        return csr_array(-(q**3)[:, None])


class Bare(Duffing):
    """Only a force and its dq; the stiffness does not count."""

    name = "bare"
    dtheta = None  # type: ignore[assignment]


class Blind:
    """A force without derivatives."""

    name = "blind"

    def force(self, t: float, q: Array, v: Array) -> Array:
        return np.ones_like(q)


class Hardening(Springs):
    """Springs with another force: what Springs says of its second derivatives does not hold for it."""

    def force(self, t: float, q: Array, v: Array) -> Array:
        return super().force(t, q, v) - q**3

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        return csr_array(super().dq(t, q, v) + diagonal(-3 * q**2))


class Thrust(Actuation):
    """Actuation through the square of its parameters, one row of which belongs to a step."""

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self.forces[self._row(t)].ravel() ** 2 * (1 + q)

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        return diagonal(self.forces[self._row(t)].ravel() ** 2)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        scale = 2 * self.forces[self._row(t)].ravel() * (1 + q)
        return csr_array(diagonal(scale) @ super().dtheta(t, q, v))


PAIRS = [(0, 1), (1, 2)]
CUSTOM: dict[str, Any] = {
    "with parameters": lambda: Duffing(),
    "dq alone": lambda: Bare(),
    "subclass": lambda: Hardening(PAIRS, 0.8, 20.0),
    "window": lambda: Thrust(np.random.default_rng(7).normal(size=(STEPS, 3, 2)), H),
}


@pytest.mark.parametrize("case", CUSTOM)
@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_effects_of_users(case: str, stepper: Any) -> None:
    """Without a `curvature` of their own they are differenced, and the system says so."""
    rng = np.random.default_rng(8)
    effect = CUSTOM[case]()
    system = System(rng.uniform(0.5, 2, 3), [effect, Gravity([0.1, -1.0]), Blind()], 2, fixed=[1])
    assert system.curvature_differenced == (effect.name, "blind")
    y0, objective, d = rng.normal(size=12), bent(system), directions(system)[0]
    if case == "dq alone":
        d[system.size + 3] = 0  # its stiffness
    found = objective.product(simulate(stepper, system, y0, H, STEPS), d)
    assert apart(found, measured(stepper, system, y0, objective, d)) < 1e-8


def test_a_parameter_without_dtheta_does_not_count() -> None:
    """In the products as in gradients and sensitivities: whatever the direction says of it."""
    system = System([1.0, 2.0], Bare(), 1)
    trajectory = simulate(SymplecticEuler(), system, [0.5, 1.0, 0.0, 1.0], H, STEPS)
    change = np.array([0.3, -0.2, 0.0])
    still = hessian_product(trajectory, np.ones(4), (np.ones(4), change))
    turned = hessian_product(trajectory, np.ones(4), (np.ones(4), change + np.array([0.0, 0.0, 5.0])))
    np.testing.assert_array_equal(turned.y0, still.y0)
    np.testing.assert_array_equal(turned.theta, still.theta)
    assert np.abs(still.y0).max() > 1e-4 and still["bare.stiffness"] == 0


def test_a_stale_curvature_is_not_used() -> None:
    """Mutation: with the curvature of Springs, the subclass with another force would be wrong."""
    hardening = Hardening([(0, 1), (1, 2), (2, 3), (3, 4)], 0.8, 20.0)
    assert _deviation(hardening) < 1e-8
    stale = type("Stale", (Hardening,), {"curvature": Springs.curvature})([(0, 1), (1, 2)], 0.8, 20.0)
    assert _deviation(stale) > 1e-2


def test_coincident_ends_stay_finite() -> None:
    """A spring and a damper of length 0: no direction, no curvature, no NaN and no warning."""
    q, v = np.array([0.5, 0.5, 0.5, 0.5, 1.0, 2.0]), np.arange(6.0)
    rng = np.random.default_rng(0)
    for effect in (Springs(PAIRS, 1.0, 5.0), SpringDamping(PAIRS, 0.3)):
        system = System(np.ones(3), effect, 2)
        bars = np.zeros(system.parameter_count)
        change = (rng.normal(size=6), rng.normal(size=6), rng.normal(size=system.parameter_count))
        assert np.isfinite(system.curvature(0.0, (q, v), rng.normal(size=6), change, bars)).all()
        assert np.isfinite(bars).all()


def test_differences_of_points() -> None:
    """A point that moves far does not spoil one that hardly moves; f = x^3 by hand."""
    x, dx = np.array([[1.0, 2.0], [0.5, 300.0]]), np.array([[1e3, 0.0], [1e-6, 3e-4]])
    exact = np.einsum("ni,ij->nij", 6 * x * dx, np.eye(2))
    for found, digits in ((change_of_jacobian(lambda z: -cubic_jacobian(z), x, dx), 1e-9),
                          (change_of_slopes(lambda z: z**3, x, dx), 1e-7)):  # fmt: skip
        assert (np.abs(found - exact).max(axis=(1, 2)) <= digits * np.abs(exact).max(axis=(1, 2))).all()
    assert not change_of_slopes(lambda z: z**3, x, np.zeros((2, 2))).any()
    assert slope(np.exp, 1e-2) == pytest.approx(1.0, abs=1e-9)


# Mutations of the sweep


@pytest.fixture(scope="module")
def reference() -> Any:
    system, y0 = everything()
    objective, d = bent(system), directions(system)[0]
    trajectory = simulate(BackwardEuler(), system, y0, H, STEPS)
    expected = measured(BackwardEuler(), system, y0, objective, d)
    assert apart(objective.product(trajectory, d), expected) < 1e-8
    return trajectory, objective, d, expected


def _no_curvature(self: Any, t: float, place: Any, w: Array, change: Any, theta_bar: Array) -> Any:
    return np.zeros(self.n), np.zeros(self.n)


def _no_mass(original: Any) -> Any:
    return lambda *a: (0.0, original(*a)[1])


def _not_transposed(self: Any, number: int, bar: Array) -> Array:
    return self._factor(number).solve(bar)


def _primal_only(original: Any) -> Any:
    """Forgets the change of the stage rates."""

    def forgetful(self: Any, t: float, place: Any, w: Array, change: Any, theta_bar: Array) -> Any:
        return original(self, t, place, w, (0 * change[0], *change[1:]), theta_bar)

    return forgetful


SWEEPS: dict[str, tuple[Any, str, Any]] = {
    "no curvature": (System, "curvature", _no_curvature),
    "no change of the mass": (System, "stage_curvature", _no_mass(System.stage_curvature)),
    "no change of the rates": (System, "stage_curvature", _primal_only(System.stage_curvature)),
    "not transposed": (RuleLinearization, "_solve_transposed", _not_transposed),
}


@pytest.mark.parametrize("case", SWEEPS)
def test_a_wrong_sweep_is_red(case: str, reference: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    trajectory, objective, d, expected = reference
    monkeypatch.setattr(*SWEEPS[case])
    assert apart(objective.product(trajectory, d), expected) > 1e-6


def test_a_forgotten_second_derivative_of_the_objective_is_red(reference: Any) -> None:
    trajectory, objective, d, expected = reference
    direction = tuple(np.split(d, [trajectory.system.size]))
    found = hessian_product(trajectory, objective.by_states(trajectory), direction)
    assert apart(np.append(found.y0, found.theta), expected) > 1e-3


# Cost


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    counts = {"__init__": 0, "solve": 0, "solve_transposed": 0}

    def wrap(name: str) -> Any:
        original = getattr(DenseFactor, name)

        def call(self: Any, *a: Any) -> Any:
            counts[name] += 1
            return original(self, *a)

        return call

    for name in counts:
        monkeypatch.setattr(DenseFactor, name, wrap(name))
    return counts


@pytest.mark.parametrize("rows", [STEPS, 40])
def test_three_solves_a_step_however_many_parameters(counted: dict[str, int], rows: int) -> None:
    """One factorization, one solve forward, two transposed; the second direction factorizes nothing."""
    system, y0 = everything(rows)
    trajectory = simulate(BackwardEuler(), system, y0, H, STEPS)
    objective, (a, b) = bent(system), directions(system)
    linear = Linearizations(trajectory)
    counted.update(dict.fromkeys(counted, 0))
    objective.product(trajectory, a, linear)
    assert counted == {"__init__": STEPS, "solve": STEPS, "solve_transposed": 2 * STEPS}
    objective.product(trajectory, b, linear)
    assert counted == {"__init__": STEPS, "solve": 2 * STEPS, "solve_transposed": 4 * STEPS}


def test_without_room_factors_are_made_again(counted: dict[str, int], monkeypatch: pytest.MonkeyPatch) -> None:
    system, y0 = everything()
    trajectory = simulate(BackwardEuler(), system, y0, H, STEPS)
    objective, d = bent(system), directions(system)[0]
    expected = objective.product(trajectory, d)
    monkeypatch.setattr("dsim.gradients.second_order.FACTOR_BYTES", 1000)
    counted.update(dict.fromkeys(counted, 0))
    linear = Linearizations(trajectory)
    np.testing.assert_array_equal(objective.product(trajectory, d, linear), expected)
    assert counted["__init__"] == STEPS + 1 and 0 < linear.nbytes <= 1000


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_a_step_touches_only_its_own_parameters(stepper: Any) -> None:
    """Parameters grow with the steps: beside the direction's copy and the two gradients, nothing of their size."""
    steps, points, peaks = 8, 20_000, []
    for rows in (steps, 4 * steps):
        system = System(np.ones(points), Actuation(np.zeros((rows, points, 1)), H), dimension=1)
        trajectory = simulate(stepper, system, np.zeros(2 * points), H, 1)
        dtheta = np.ones(system.parameter_count)
        tracemalloc.start()
        hessian_product(trajectory, np.ones(2 * points), (None, dtheta))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] <= 1.1 * 8 * 3 * (3 * steps * points)


# Gauss-Newton


def observed(trajectory: Any) -> tuple[Array, Any, Array]:
    """All states, and the masses by themselves."""
    size, P = trajectory.y.size, trajectory.system.parameter_count
    by_theta = np.zeros((size + 4, P))
    by_theta[size:, :4] = 3 * np.eye(4)
    return np.append(trajectory.y.ravel(), 3 * trajectory.system.mass), eye_array(size + 4, size).tocsr(), by_theta


def test_gauss_newton_is_the_hessian_without_residuals() -> None:
    """J = r^T W r / 2: at r = 0 the curvature of the simulation has no weight; away from it, it has."""
    system, y0 = everything()
    trajectory = simulate(BackwardEuler(), system, y0, H, STEPS)
    r, drdy, drdtheta = observed(trajectory)
    weights = np.random.default_rng(3).uniform(0.5, 2, len(r))
    direction = tuple(np.split(directions(system)[0], [system.size]))
    path = weights[: trajectory.y.size].reshape(trajectory.y.shape)

    def change(dy: Array, dtheta: Array) -> Any:
        return path * dy, drdtheta.T @ (weights * (drdtheta @ dtheta))

    for form in (weights, np.diag(weights)):
        found = gauss_newton_product(trajectory, drdy, direction, drdtheta, form)
        exact = hessian_product(trajectory, np.zeros_like(path), direction, change)
        assert apart(found.y0, exact.y0) < 1e-12 and apart(found.theta, exact.theta) < 1e-12
    elsewhere = hessian_product(trajectory, path * (trajectory.y + 1.0), direction, change)
    assert apart(found.theta, elsewhere.theta) > 1e-2
    along = found.y0 @ direction[0] + found.theta @ direction[1]
    dr = jacobian_product(trajectory, drdy, direction, drdtheta)
    assert along == pytest.approx(dr @ (weights * dr), rel=1e-12)


def test_gauss_newton_of_a_linear_simulation_is_the_hessian() -> None:
    """The start of a ball under gravity enters its path linearly, so r = y - data may be as large as it likes."""
    trajectory = simulate(BackwardEuler(), System([1.0], Gravity([0.0, -10.0]), 2), [0.0, 0, 3, 4], 0.1, 5)
    d = np.array([0.2, -1.0, 0.5, 2.0])
    found = gauss_newton_product(trajectory, eye_array(trajectory.y.size), (d, None))
    exact = hessian_product(trajectory, trajectory.y - 7.0, (d, None), lambda dy, _: dy)
    np.testing.assert_allclose(found.y0, exact.y0, rtol=1e-12)
    there = jacobian_product(trajectory, np.eye(24), (d, None))[-4:-2]
    np.testing.assert_allclose(there, d[:2] + 0.5 * d[2:], atol=1e-15)


def test_jacobian_transposed_is_the_transpose() -> None:
    system, y0 = everything()
    trajectory = simulate(ImplicitMidpoint(), system, y0, H, STEPS)
    r, drdy, drdtheta = observed(trajectory)
    u, (d, _) = np.random.default_rng(6).normal(size=len(r)), directions(system)
    back = jacobian_transposed(trajectory, drdy, u, drdtheta)
    forth = jacobian_product(trajectory, drdy, tuple(np.split(d, [system.size])), drdtheta)
    assert np.append(back.y0, back.theta) @ d == pytest.approx(u @ forth, rel=1e-11)


# Optimisers


def throw(system: Any, y0: Array) -> Any:
    return simulate(BackwardEuler(tol=1e-13), system, y0, 0.1, 8)


def aimed() -> tuple[ReducedObjective, Variables]:
    """A ball in drag on a spring: its start velocity and the stiffness, so that it is at (1.5, 0.5) in the end."""
    spring = Springs([(0, 1)], 1.0, 4.0)
    system = System([1.0, 1.0], [Gravity([0.0, -5.0]), Drag(0.3), spring], 2, fixed=[0])
    aim = Variables(system, [0.0, 0, 1, 0, 0, 0, 2, 5], {"velocities": [2, 3], "springs.stiffness": ...})

    def miss(trajectory: Any) -> Any:
        gap, load = trajectory.last[2:4] - [1.5, 0.5], np.zeros(8)
        load[2:4] = gap
        k = trajectory.system.theta[-1]
        return gap @ gap / 2 + 0.05 * (k - 4) ** 2, load, {"springs.stiffness": [0.1 * (k - 4)]}

    def bends(trajectory: Any, dy: Array, dtheta: Array) -> Any:
        change = np.zeros(8)
        change[2:4] = dy[-1, 2:4]
        return change, {"springs.stiffness": [0.1 * dtheta[-1]]}

    return ReducedObjective(throw, aim, miss, bends), aim


def test_newton_converges_quadratically() -> None:
    """H from products alone, its equation by conjugate gradients: |g| falls as its square, in five steps."""
    fit, aim = aimed()
    p, slopes = aim.start, []
    for _ in range(7):
        _, gradient = fit(p)
        slopes.append(float(np.abs(gradient).max()))
        hessian = LinearOperator((3, 3), matvec=lambda d, p=p: fit.hessp(p, d), dtype=float)
        dp, _ = cg(hessian, -gradient, rtol=1e-13, atol=0.0)
        p = p + dp
        if slopes[-1] < 1e-12:
            break
    assert slopes[-1] < 1e-12 and len(slopes) <= 7
    orders = [np.log(c / b) / np.log(b / a) for a, b, c in zip(slopes, slopes[1:], slopes[2:], strict=False)]
    assert max(orders) > 1.8


@pytest.mark.parametrize("method", ["trust-ncg", "Newton-CG"])
def test_scipy_takes_products(method: str) -> None:
    fit, aim = aimed()
    found = scipy.optimize.minimize(fit, aim.start, jac=True, hessp=fit.hessp, method=method, options={"maxiter": 30})
    assert np.abs(fit(found.x)[1]).max() < 1e-5 and found.nfev <= 12


def test_hessp_is_the_difference_of_gradients_and_runs_once() -> None:
    fit, aim = aimed()
    runs = []

    def counted(system: Any, y0: Array) -> Any:
        runs.append(1)
        return throw(system, y0)

    fit = ReducedObjective(counted, aim, fit.objective, fit.second)
    fit(aim.start)
    products = np.array([fit.hessp(aim.start, d) for d in np.eye(3)])
    assert len(runs) == 1
    d = np.array([[0.5], [-1.0], [2.0]])
    assert apart(products @ d, directional(lambda p: fit(p)[1], aim.start, d)) < 1e-8
    np.testing.assert_allclose(products, products.T, rtol=1e-11)


def test_least_squares_takes_an_operator() -> None:
    """Many variables: J is never formed, a product is a sweep."""
    system, y0 = everything()
    variables = Variables(system, y0, {"springs.stiffness": [0, 2], "velocities": [2]})
    truth = variables.start * [0.9, 1.05, 1.1]
    seen = simulate(BackwardEuler(), *variables.place(truth), H, STEPS).y

    def gap(trajectory: Any) -> Any:
        return (trajectory.y - seen).ravel(), eye_array(seen.size)

    fit = Residuals(lambda system, y0: simulate(BackwardEuler(), system, y0, H, STEPS), variables, gap)
    operator = fit.operator(variables.start)
    np.testing.assert_allclose(operator @ np.eye(3), fit.jacobian(variables.start), rtol=1e-10, atol=1e-14)
    u = np.random.default_rng(4).normal(size=seen.size)
    np.testing.assert_allclose(operator.T @ u, fit.jacobian(variables.start).T @ u, rtol=1e-10)
    found = scipy.optimize.least_squares(fit, variables.start, jac=fit.operator, tr_solver="lsmr", xtol=1e-14)
    assert np.abs(found.x / truth - 1).max() < 1e-6


# Bad input


def ball() -> Any:
    return simulate(BackwardEuler(), System([1.0], Gravity([-10.0]), 1), [0.0, 1.0], 0.1, 3)


class Foreign(BackwardEuler):
    """A stepper with first derivatives only."""

    def linearize(self, system: Any, step: Any) -> Any:
        return object()


BAD: dict[str, tuple[Any, str]] = {
    "direction": (lambda t: hessian_product(t, np.ones(2), np.ones(2)), r"direction must be a pair \(dy0, dtheta\)"),
    "columns": (lambda t: hessian_product(t, np.ones(2), (np.eye(2), None)), "one direction; got 2 columns"),
    "dy0": (lambda t: hessian_product(t, np.ones(2), (np.ones(3), None)), "dy0 must have shape"),
    "dtheta": (lambda t: hessian_product(t, np.ones(2), (None, np.ones(3))), "dtheta must have shape"),
    "dJdy": (lambda t: hessian_product(t, np.ones(3), (np.ones(2), None)), r"dJdy must have shape \(4, 2\)"),
    "d2J array": (lambda t: hessian_product(t, np.ones(2), (None, None), np.eye(2)), "d2J must be a callable"),
    "d2J shape": (lambda t: hessian_product(t, np.ones(2), (None, None), lambda dy, _: 1.0), "d2J's change of dJdy"),
    "d2J parts": (lambda t: hessian_product(t, np.ones(2), (None, None), lambda dy, _: (dy,)), "got 1 parts"),
    "d2J name": (
        lambda t: hessian_product(t, np.ones(2), (None, None), lambda dy, _: (dy, {"mas": [1.0]})),
        "dJdtheta must name parameters",
    ),
    "factors of another": (
        lambda t: hessian_product(t, np.ones(2), (None, None), None, Linearizations(ball())),
        "linearizations must be those of this trajectory",
    ),
    "drdy": (lambda t: gauss_newton_product(t, np.ones((2, 2)), (None, None)), r"drdy must have shape \(m, 8\)"),
    "drdy number": (lambda t: gauss_newton_product(t, 1.0, (None, None)), r"drdy must have shape \(m, 8\)"),
    "drdtheta": (
        lambda t: gauss_newton_product(t, np.ones((2, 8)), (None, None), np.ones((2, 1))),
        r"drdtheta must have shape \(2, 2\)",
    ),
    "weights": (
        lambda t: gauss_newton_product(t, np.ones((2, 8)), (None, None), None, np.ones(3)),
        r"weights must have shape \(2,\) or \(2, 2\)",
    ),
    "u": (lambda t: jacobian_transposed(t, np.ones((2, 8)), np.ones(3)), r"u must have shape \(2,\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case: str) -> None:
    call, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        call(ball())


def test_a_stepper_or_a_run_without_second_derivatives_is_named() -> None:
    run = simulate(Foreign(), System([1.0], Gravity([-10.0]), 1), [0.0, 1.0], 0.1, 3)
    with pytest.raises(ValueError, match=r"must offer second derivatives .*; Foreign has none"):
        hessian_product(run, np.ones(2), (np.ones(2), None))
    stiff = System([1.0, 1.0], Springs([(0, 1)], 1.0, 1e8), dimension=1, fixed=[0])
    failed = record(ForwardEuler(), stiff, [0.0, 1.5, 0.0, 0.0], 0.01, 400)
    with pytest.raises(ValueError, match="must be a run that reached its end"):
        hessian_product(failed, np.ones(4), (np.ones(4), None))


def test_hessp_needs_the_objectives_own_bend() -> None:
    fit, aim = aimed()
    with pytest.raises(ValueError, match="second must be given"):
        ReducedObjective(fit.run, aim, fit.objective).hessp(aim.start, np.ones(3))
    with pytest.raises(ValueError, match=r"dp must have shape \(3,\)"):
        fit.hessp(aim.start, np.ones(4))
