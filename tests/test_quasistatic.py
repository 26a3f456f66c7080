"""Equilibria and their derivatives: closed forms, differences, both directions, and a status where there is none."""

import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array

import dsim
from dsim import EquilibriumError, System, quasistatic, scenes
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.gradients.quasistatic import record
from dsim.gradients.statics import StaticProblem
from dsim.scenes.nets import lattice
from dsim.solve.band import Band
from dsim.solve.curvature import softest_mode
from dsim.solve.linear import NotDefiniteError, factorize_definite
from dsim.solve.newton import Status
from dsim.studies import check_gradient
from dsim.studies.hard_cases.equilibria import DeadLoad, Hinge

SWIRL = np.array([[-1.0, 2.0], [-2.0, -1.0]])
HANGING = [0.0, 0.0, 1.0, 0.0]


def hanging(*more, load=-10.0, springs=Springs):
    """A point of 2 kg on a spring of 1 m and 50 N/m below a hook."""
    return System([1.0, 2.0], [springs([(0, 1)], 1.0, 50.0), Gravity([0.0, load]), *more], dimension=2, fixed=[0])


def net(n, springs=Springs):
    """n x n points, hung by two corners, in a plane that is not the load's; stretched everywhere but not alike."""
    x, sides, diagonals = lattice((n, n), 1.0 / (n - 1))
    edges = np.concatenate([sides, diagonals])
    rng = np.random.default_rng(7)
    rest = 0.9 * np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    effects = [springs(edges, rest, rng.uniform(200, 400, len(edges))), Gravity([0.5, 1.0, -9.81])]
    border = np.flatnonzero((x == x.min()).any(axis=1))
    system = System(rng.uniform(0.05, 0.1, n * n), effects, dimension=3, fixed=border)
    return system, np.column_stack([x, np.zeros(n * n)]).ravel()


def moved(system, q0, direction, step):
    """The equilibrium at theta + step * direction, as a position."""
    found = quasistatic(system.with_theta(system.theta + step * direction), q0)
    assert found.status is Status.CONVERGED
    return found.q


def worst_column(system, q0, directions):
    """The largest relative error of a tangent against a central difference."""
    rest = quasistatic(system, q0)
    errors = []
    for direction in directions:
        tangent = rest.linearize().tangent(direction)
        difference = (moved(system, rest.q, direction, 1e-5) - moved(system, rest.q, direction, -1e-5)) / 2e-5
        errors.append(np.abs(tangent - difference).max() / np.abs(difference).max())
    return max(errors)


def directions(system):
    """One random direction in every named parameter, of a size that suits it."""
    rng, columns = np.random.default_rng(3), []
    for name, values in system.split(system.theta).items():
        whole = np.zeros(system.parameter_count)
        system.split(whole)[name][...] = rng.normal(size=values.shape) * np.abs(values).max()
        columns.append(whole)
    return columns


# Closed forms


def test_a_spring_in_closed_form():
    m, k, g = 2.0, 50.0, 10.0
    rest = quasistatic(hanging(), HANGING)
    assert rest.status is Status.CONVERGED and rest.status == "converged" and rest.kicks == 0
    assert np.allclose(rest.q, [0, 0, 0, -(1 + m * g / k)], atol=1e-12)
    assert np.array_equal(rest.y, [*rest.q, 0, 0, 0, 0])
    linear = rest.linearize()
    assert np.allclose(linear.jacobian("springs.rest_length")[:, 0], [0, 0, 0, -1], atol=1e-12)
    assert np.allclose(linear.jacobian("springs.stiffness")[:, 0], [0, 0, 0, m * g / k**2], atol=1e-12)
    assert np.allclose(linear.jacobian("mass"), [[0, 0], [0, 0], [0, 0], [0, -g / k]], atol=1e-12)
    sideways = (1 + m * g / k) / g  # m: a pendulum follows its gravity
    assert np.allclose(linear.jacobian("gravity.acceleration"), [[0, 0], [0, 0], [sideways, 0], [0, m / k]], atol=1e-12)


def test_a_body_follows_its_pins():
    linear = quasistatic(hanging(), HANGING).linearize()
    dq0 = np.array([0.3, -0.2, 5.0, 5.0])
    assert np.allclose(linear.tangent(np.zeros(hanging().parameter_count), dq0), [0.3, -0.2, 0.3, -0.2], atol=1e-12)
    theta_bar = np.zeros(hanging().parameter_count)
    assert np.allclose(linear.pullback(np.array([0.0, 0.0, 1.0, 2.0]), theta_bar), [1.0, 2.0, 0.0, 0.0], atol=1e-12)


def test_the_state_is_where_a_simulation_stays():
    rest = quasistatic(hanging(SpringDamping([(0, 1)], 3.0)), HANGING)
    run = dsim.simulate(dsim.steppers.BackwardEuler(), rest.system, rest.y, 0.01, 20)
    assert np.allclose(run.q, rest.q, atol=1e-10)


def test_a_force_of_its_own_time():
    push = Actuation(np.arange(6.0).reshape(3, 1, 2), 0.1)
    system = System([1.0], [push, Field(lambda x: -2 * x, lambda x: -2 * np.eye(2)[None])], dimension=2)
    assert np.allclose(quasistatic(system, [0.0, 0.0], t=0.15).q, [1.0, 1.5], atol=1e-12)


def test_what_does_nothing_at_rest_spoils_no_descent():
    damped = hanging(SpringDamping([(0, 1)], 3.0), Drag(0.5))
    assert StaticProblem(damped, 0.0, np.array(HANGING)).conservative
    assert np.allclose(quasistatic(damped, HANGING).q, quasistatic(hanging(), HANGING).q, atol=1e-12)


def test_a_steady_wind_leans_on_a_pendulum():
    rest = quasistatic(hanging(Drag(0.5, wind=[3.0, 0.0])), HANGING)
    pull = np.array([1.5, -20.0])
    assert np.allclose(rest.q[2:], pull / np.linalg.norm(pull) * (1 + np.linalg.norm(pull) / 50), atol=1e-10)


# Differences, both directions, the definition


@pytest.mark.parametrize("n", [3, 8], ids=["dense", "sparse"])
def test_tangents_against_differences(n):
    system, q0 = net(n)
    assert worst_column(system, q0, directions(system)) < 1e-7


class Sloppy(Springs):
    """Springs whose derivative by their parameters is 1 % too large."""

    def dtheta(self, t, q, v):
        return 1.01 * super().dtheta(t, q, v)


class Stiffer(Springs):
    """Springs whose stiffness matrix is 1 % too large."""

    def dq(self, t, q, v):
        return 1.01 * super().dq(t, q, v)


@pytest.mark.parametrize("springs", [Sloppy, Stiffer])
def test_a_wrong_derivative_is_seen(springs):
    system, q0 = net(3, springs)
    assert worst_column(system, q0, directions(system)) > 1e-3


@pytest.mark.parametrize("n", [3, 8], ids=["dense", "sparse"])
def test_the_adjoint_is_the_transposed_jacobian(n):
    system, q0 = net(n)
    rest, rng = quasistatic(system, q0), np.random.default_rng(0)
    mu, explicit = rng.normal(size=system.n), rng.normal(size=system.parameter_count)
    gradient = rest.adjoint(mu, explicit)
    whole = rest.linearize().jacobian()
    assert np.allclose(gradient.theta, whole.T @ mu + explicit, rtol=1e-9, atol=1e-10)
    pins = rest.linearize().tangent(np.zeros((system.parameter_count, system.n)), np.eye(system.n))
    assert np.allclose(gradient.y0, [*(pins.T @ mu), *np.zeros(system.n)], rtol=1e-9, atol=1e-10)
    assert np.array_equal(gradient["mass"], system.split(gradient.theta)["mass"])


def test_tangents_solve_the_linearized_residual():
    system, q0 = net(4)
    linear, rng = quasistatic(system, q0).linearize(), np.random.default_rng(1)
    dtheta, dq0 = rng.normal(size=(system.parameter_count, 3)), rng.normal(size=(system.n, 3))
    left = linear.A @ linear.tangent(dtheta, dq0) + linear.B @ dq0 + linear.C @ dtheta
    assert np.abs(left).max() < 1e-11 * np.abs(linear.C @ dtheta).max()
    one = linear.tangent(dtheta[:, 0], dq0[:, 0])
    assert np.allclose(one, linear.tangent(dtheta, dq0)[:, 0], rtol=1e-12, atol=1e-14)


def test_an_objective_with_an_explicit_part():
    """O = |x*|^2 / 2 + k^2 / 2e4, by the spring's stiffness k."""

    def energy(k):
        system = hanging()
        theta = system.join(**{"springs.stiffness": k})
        rest = quasistatic(system.with_theta(theta), HANGING)
        explicit = {"springs.stiffness": k / 1e4}
        return 0.5 * rest.q @ rest.q + k[0] ** 2 / 2e4, rest.adjoint(rest.q, explicit)["springs.stiffness"]

    k = np.array([50.0])
    report = check_gradient(lambda k: energy(k)[0], k, gradient=energy(k)[1])
    assert report.ok and report.verdict == "smooth"
    forgotten = energy(k)[1] - k / 1e4
    assert check_gradient(lambda k: energy(k)[0], k, gradient=forgotten).verdict == "wrong"


def test_all_columns_on_one_factorization(monkeypatch):
    module = sys.modules["dsim.gradients.quasistatic"]
    calls, real = [], module.factorize
    monkeypatch.setattr(module, "factorize", lambda *matrix: calls.append(1) or real(*matrix))
    system, q0 = net(3)
    linear = quasistatic(system, q0).linearize()
    linear.jacobian()
    linear.pullback(np.ones(system.n), np.zeros(system.parameter_count))
    assert calls == [1]
    system, q0 = net(8)  # sparse and stable: the search's own factor of the exact matrix serves
    quasistatic(system, q0).linearize().jacobian("mass")
    assert calls == [1]


def test_forces_without_a_potential():
    swirl = Field(lambda x: x @ SWIRL.T + [1, 0], lambda x: np.broadcast_to(SWIRL, (len(x), 2, 2)))
    system = System([1.0], [swirl], 2)
    assert not StaticProblem(system, 0.0, np.zeros(2)).conservative
    assert np.allclose(quasistatic(system, [5.0, 5.0]).q, np.linalg.solve(SWIRL, [-1, 0]), atol=1e-12)


@pytest.mark.parametrize("points", [20, 100], ids=["dense", "sparse"])
def test_a_chain_in_a_swirl(points):
    swirl = Field(lambda x: 0.01 * (x @ SWIRL.T), lambda x: np.broadcast_to(0.01 * SWIRL, (len(x), 2, 2)))
    x = np.column_stack([np.linspace(0, 1, points), np.zeros(points)])
    links = Springs([(i, i + 1) for i in range(points - 1)], 0.9 / (points - 1), 100.0)
    system = System(np.full(points, 0.01), [links, swirl], 2, fixed=[0, points - 1])
    assert worst_column(system, x.ravel(), directions(system)[1:]) < 1e-6
    rest, mu = quasistatic(system, x.ravel()), np.sin(np.arange(system.n))
    assert np.allclose(rest.adjoint(mu).theta, rest.linearize().jacobian().T @ mu, rtol=1e-9, atol=1e-12)


# What the search does


def test_newton_ends_quadratically():
    assert quasistatic(hanging(), HANGING).counters.newton_iterations <= 10


def test_a_cloth_of_1200_coordinates():
    cloth = scenes.cloth(n=20)
    rest = quasistatic(cloth.system, cloth.y0[: cloth.system.n])
    force = cloth.system.free * cloth.system.force(0.0, rest.q, 0 * rest.q)
    assert rest.status is Status.CONVERGED and rest.counters.newton_iterations <= 100
    assert np.abs(force).max() < 1e-10 * 9.81 * cloth.system.mass.max()


def test_an_unstable_equilibrium_is_left():
    upright = [0.0, 0.0, 0.0, 0.6]
    rest = quasistatic(hanging(), upright)
    assert rest.status is Status.CONVERGED and rest.kicks == 1 and np.allclose(rest.q[2:], [0, -1.4], atol=1e-9)
    top = quasistatic(hanging(), upright, kicks=0)
    assert top.status is Status.UNSTABLE and np.allclose(top.q[2:], [0, 0.6]) and top.eigenvalue < 0
    with pytest.raises(EquilibriumError, match=r"unstable; not a minimum .* allow more kicks"):
        top.linearize()


# No equilibrium, or none to differentiate


def strut(load):
    return System([1.0], [Hinge(1.0), DeadLoad(load, 1.0)], dimension=1)


SINGULAR = {
    "a bifurcation": (strut(1.0), [0.0]),
    "a body nobody holds": (System([1.0, 1.0], [Springs([(0, 1)], 1.0, 10.0)], 2), [0, 0, 2, 0]),
    "no force at all": (System([1.0], [], 2), [0.0, 0.0]),
    "a free line": (System([1.0], [Field(lambda x: x * [-1, 0], lambda x: np.diag([-1.0, 0.0])[None])], 2), [3.0, 1.0]),
}


@pytest.mark.parametrize("name", SINGULAR)
def test_a_status_where_there_is_no_derivative(name):
    found = quasistatic(*SINGULAR[name])
    assert found.status is Status.SINGULAR and found.imbalance <= 1e-10
    for ask in (found.linearize, lambda: found.adjoint(np.ones(found.system.n))):
        with pytest.raises(EquilibriumError, match="singular; a fold, a bifurcation or a free motion") as error:
            ask()
        assert error.value.status is Status.SINGULAR and error.value.equilibrium is found


@pytest.mark.parametrize("load", [0.999, 1.001])
def test_beside_a_bifurcation_there_is_one(load):
    assert quasistatic(strut(load), [0.0]).linearize().jacobian("load.force_down").shape == (1, 1)


class Wrong(Springs):
    """Springs whose energy is not that of their force."""

    def energy(self, t, q):
        return -super().energy(t, q)


def field(force, slope):
    return System([1.0], [Field(force, lambda x: slope(x)[:, :, None])], 1)


FAILS = {
    "free fall": (System([1.0], [Gravity([0.0, -9.81])], 2), [0.0, 0.0], {}, Status.NO_EQUILIBRIUM),
    "a force that is nowhere 0": (field(lambda x: 1 + x**2, lambda x: 2 * x), [5.0], {}, Status.NO_EQUILIBRIUM),
    "a fall into a sun": (scenes.kepler().system, [1.0, 0.0], {}, Status.NO_EQUILIBRIUM),
    "too few iterations": (hanging(), HANGING, {"max_iterations": 2}, Status.MAX_ITERATIONS),
    "the energy of another force": (hanging(springs=Wrong), HANGING, {}, Status.LINE_SEARCH_FAILED),
    "nan": (field(lambda x: np.sqrt(x), lambda x: x), [-1.0], {}, Status.NOT_FINITE),
}


@pytest.mark.parametrize("name", FAILS)
def test_an_error_with_a_status_where_there_is_none(name):
    system, q0, options, status = FAILS[name]
    with pytest.raises(EquilibriumError, match=f"no equilibrium to go on with: {status}; ") as error:
        quasistatic(system, q0, **options)
    assert error.value.status is status and error.value.equilibrium.q.shape == (system.n,)
    found = record(system, q0, **options)
    assert found.status is status
    with pytest.raises(EquilibriumError):
        found.adjoint(np.ones(system.n))


@pytest.mark.parametrize("ratio", [1e4, 1e7])
def test_a_soft_body_is_no_fold(ratio):
    """Two springs in a row, one stiffer by far: a small eigenvalue that stays as it is."""
    springs = Springs([(0, 1), (1, 2)], 1.0, [ratio, 1.0])
    line = System(np.ones(3), [springs, Gravity([-0.1])], dimension=1, fixed=[0])
    rest = quasistatic(line, [0.0, 1.0, 2.0])
    assert rest.status is Status.CONVERGED and rest.eigenvalue < 2 / ratio
    assert np.isclose(rest.linearize().jacobian("springs.stiffness")[2, 1], 0.1, rtol=1e-7)


# Beneath: modes, factors


def spectrum(values, seed=0):
    """A sparse symmetric matrix (n,n) with these eigenvalues, and their vectors."""
    n = len(values)
    blocks = [np.linalg.qr(np.random.default_rng(seed + i).normal(size=(4, 4)))[0] for i in range(n // 4)]
    turn = np.zeros((n, n))
    for i, block in enumerate(blocks):
        turn[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = block
    return turn @ np.diag(values) @ turn.T


@pytest.mark.parametrize("smallest", [1e-4, -0.5, -3.0])
@pytest.mark.parametrize("banded", [True, False])
def test_the_softest_mode_of_a_sparse_matrix(smallest, banded):
    values = np.concatenate([[smallest], np.linspace(1.0, 9.0, 159)])
    dense = spectrum(values)
    matrix = csr_array(dense)
    band = Band(matrix) if banded else None
    mode = softest_mode(matrix, band, np.arange(160), symmetric=True)
    assert np.isclose(mode.value, smallest, rtol=1e-5, atol=1e-10)
    assert np.linalg.norm(dense @ mode.right - smallest * mode.right) < 1e-4
    assert (mode.factor is None) == (smallest < 0) and 7 < mode.largest <= 12


def test_the_smallest_singular_value_of_a_sparse_matrix():
    rng = np.random.default_rng(2)
    matrix = csr_array(
        diags_array([np.full(199, -0.3), np.full(200, 1.0), rng.uniform(0, 0.5, 199)], offsets=[-1, 0, 1])
    )
    mode = softest_mode(matrix, None, np.arange(200), symmetric=False)
    exact = np.linalg.svd(matrix.toarray(), compute_uv=False)[-1]
    assert np.isclose(mode.value, exact, rtol=1e-4) and mode.left.shape == mode.right.shape == (200,)


@pytest.mark.parametrize("banded", [True, False])
def test_a_definite_factor_leads_downhill(banded):
    matrix = csr_array(spectrum(np.linspace(-1.0, 9.0, 160)))
    factor = factorize_definite(matrix, Band(matrix) if banded else None)
    for b in np.eye(160)[::40]:
        assert b @ factor.solve(b) > 0
    definite = csr_array(spectrum(np.linspace(1.0, 9.0, 160)))
    exact = factorize_definite(definite, Band(definite) if banded else None)
    assert np.allclose(definite @ exact.solve(np.ones(160)), 1.0) and exact.nbytes > 0
    with pytest.raises(NotDefiniteError):
        Band(matrix).factorize(matrix.data)


# Bad input


@dataclass
class Nothing:
    n: int = 2


REST = quasistatic(hanging(), HANGING)
BAD = {
    "no system": (lambda: quasistatic(Nothing(), [0, 0]), "system must be a second-order System"),
    "a flow": (lambda: quasistatic(dsim.Flow(lambda t, y: y, 2), [0, 0]), "system must be a second-order System"),
    "too short": (lambda: quasistatic(hanging(), [0.0]), r"q0 must have shape \(4,\); got \(1,\)"),
    "a state": (lambda: quasistatic(hanging(), [0.0] * 8), r"q0 must have shape \(4,\); got \(8,\)"),
    "nan": (lambda: quasistatic(hanging(), [0, 0, np.nan, 0]), "q0 must be finite; got nan at index 2"),
    "t": (lambda: quasistatic(hanging(), HANGING, t=np.inf), "t must be finite"),
    "tol": (lambda: quasistatic(hanging(), HANGING, tol=0), "tol must be > 0"),
    "iterations": (lambda: quasistatic(hanging(), HANGING, max_iterations=0), "max_iterations must be a whole number"),
    "kicks": (lambda: quasistatic(hanging(), HANGING, kicks=-1), "kicks must be a whole number"),
    "unknown name": (
        lambda: REST.linearize().jacobian("spring.stiffness"),
        "no parameter is called 'spring.stiffness'; this system has mass, springs.rest_length",
    ),
    "dtheta": (lambda: REST.linearize().tangent(np.ones(3)), r"dtheta must have shape \(6,\) or \(6, k\); got \(3,\)"),
    "dq0": (lambda: REST.linearize().tangent(np.ones(6), np.ones(5)), r"dq0 must have shape \(4,\) or \(4, k\)"),
    "columns": (
        lambda: REST.linearize().tangent(np.ones((6, 2)), np.ones((4, 3))),
        "dq0 must have as many columns as dtheta",
    ),
    "dOdq": (lambda: REST.adjoint(np.ones(8)), r"dOdq must have shape \(4,\); got \(8,\)"),
    "dOdq nan": (lambda: REST.adjoint([np.nan] * 4), "dOdq must be finite"),
    "dOdtheta": (lambda: REST.adjoint(np.ones(4), np.ones(2)), r"dOdtheta must have shape \(6,\); got \(2,\)"),
    "dOdtheta name": (lambda: REST.adjoint(np.ones(4), {"masses": [1, 2]}), "no parameter is called 'masses'"),
    "dOdtheta part": (
        lambda: REST.adjoint(np.ones(4), {"mass": [1.0]}),
        r"dOdtheta\['mass'\] must have shape \(2,\); got \(1,\)",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    ask, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        ask()


def test_an_equilibrium_cannot_be_written_to():
    with pytest.raises(ValueError, match="read-only"):
        REST.q[0] = 1.0
    assert replace(REST, status=Status.CONVERGED).linearize().jacobian().shape == (4, 6)


# Where the bounds lie


def truss(share, height=0.3):
    """Two springs that lean on each other, under this share of the load at which they snap through; near the fold."""
    length, k = np.hypot(1.0, height), 100.0
    at_fold = np.sqrt(length ** (2 / 3) - 1.0)  # d/dy of (l0/l - 1) y is 0 where l^3 = l0
    load = 2 * k * (length / np.hypot(1.0, at_fold) - 1) * at_fold
    springs, gravity = Springs([(0, 2), (1, 2)], length, k), Gravity([0.0, -load * share])
    return System(np.ones(3), [springs, gravity], dimension=2, fixed=[0, 1]), [-1, 0, 1, 0, 0, height]


def test_a_fold_is_told_from_a_place_near_it():
    """The smallest eigenvalue goes with the root of the distance: 2.3e-6 and 2.3e-7 of the largest here."""
    near, at = (record(*truss(1 - distance)) for distance in (1e-9, 1e-11))
    assert near.status is Status.CONVERGED and near.eigenvalue == pytest.approx(2.3e-6, rel=0.05)
    assert at.status is Status.SINGULAR and at.eigenvalue == pytest.approx(2.3e-7, rel=0.1)
    assert record(*truss(1.001)).q[5] < 0  # snapped through


@pytest.mark.parametrize("soft, status", [(1e-9, Status.CONVERGED), (1e-12, Status.SINGULAR)])
def test_what_is_soft_everywhere_is_no_fold_and_what_round_off_hides_is(soft, status):
    springs = [Springs([(0, 2)], 1.0, 1.0, name="stiff"), Springs([(1, 2)], 1.0, soft, name="soft")]
    corner = System(np.ones(3), springs, dimension=2, fixed=[0, 1])
    found = record(corner, [-1, 0, 0, -1, 0, 0])
    assert found.status is status and found.eigenvalue == pytest.approx(soft, rel=1e-3)


def test_a_far_equilibrium_is_one():
    """A spring that its load stretches a million times, and the same force from an effect without an energy."""
    rest = quasistatic(hanging(load=-2.5e7), HANGING)
    assert rest.q[3] == pytest.approx(-(1 + 1e6), rel=1e-12)


@dataclass(frozen=True)
class Push:
    """A constant force that tells no energy."""

    strength: float
    name: str = "push"

    def force(self, t, q, v):
        return np.full_like(q, self.strength)


def test_a_constant_force_without_an_energy_has_a_potential():
    """At rest and in its sign: down by it, up against the gravity it cancels."""
    system = hanging(Push(-30.0))
    problem = StaticProblem(system, 0.0, np.array(HANGING))
    q, step = np.array([0.0, 0.0, 0.7, -1.1]), np.array([0.0, 0.0, 3e-6, -5e-6])
    slope = (problem.potential(q + step) - problem.potential(q - step)) / 2
    assert problem.conservative and slope == pytest.approx(problem.residual(q) @ step, rel=1e-6)


def test_an_imbalance_above_round_off_counts():
    problem = StaticProblem(hanging(), 0.0, np.array(HANGING))
    q = np.array([0.0, 0.0, 0.0, -1.4])
    assert problem.imbalance(q, np.full(4, 1e-15)) == 0.0  # of the 40 N that act on the hook
    assert problem.imbalance(q, np.full(4, 2e-10)) == pytest.approx(2e-10 / 40)


def test_rigid_bodies_are_refused():
    scene = scenes.sign()
    with pytest.raises(ValueError, match="system must be one of points"):
        quasistatic(scene.system, scene.y0[: scene.system.width])
