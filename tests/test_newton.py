"""Newton's method: how it ends, how fast it converges, what globalization saves; checks that see a wrong slope."""

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array

from dsim import Status, System, newton
from dsim.effects import Gravity, SpringDamping, Springs
from dsim.solve.linear import DENSE_SIZE, factorize
from dsim.studies.newton_rate import rate, solve_step


def rate_is_quadratic(result):
    """The verdict the tests below share: the fitted order of the last corrections."""
    return result.converged and rate(result) >= 1.9


# Problems of one page: residual, Jacobian, start


def square_root(jacobian=1.0):
    return lambda z: z**2 - 2, lambda z: jacobian * np.diag(2 * z), np.array([3.0, 1.0, 8.0])


def crossing(jacobian=1.0):
    """Where a circle of radius 2 meets y = 1 - e^x."""

    def residual(z):
        x, y = z
        return np.array([x * x + y * y - 4, np.exp(x) + y - 1])

    return residual, lambda z: jacobian * np.array([2 * z, [np.exp(z[0]), 1.0]]), np.array([1.5, -1.0])


def bratu(n=30, jacobian=1.0):
    """-u'' = e^u between two zeros, by finite differences."""
    h2 = 1.0 / (n + 1) ** 2
    laplacian = diags_array([-1.0, 2.0, -1.0], offsets=(-1, 0, 1), shape=(n, n)) / h2

    def slope(u):
        return csr_array(jacobian * (laplacian - diags_array(np.exp(u))))

    return lambda u: laplacian @ u - np.exp(u), slope, 3.0 * np.ones(n)


def curved(n, jacobian=1.0, dropped=False):
    """A chain with a quartic term in every link."""

    def residual(z):
        edge = np.diff(z, prepend=0.0)
        pull = edge + edge**3 - 1.0
        return pull - np.append(pull[1:], 0.0)

    def slope(z):
        k = 1 + (0 if dropped else 3) * np.diff(z, prepend=0.0) ** 2
        diagonal = k + np.append(k[1:], 0.0)
        return jacobian * csr_array(diags_array([-k[1:], diagonal, -k[1:]], offsets=(-1, 0, 1)))

    return residual, slope, np.linspace(0.0, 0.1 * n, n) + 0.2 * np.sin(np.arange(n))


PROBLEMS = {
    "square root": square_root,
    "circle": crossing,
    "Bratu": bratu,
    "Bratu, sparse": lambda **o: bratu(DENSE_SIZE + 20, **o),
    "chain": lambda **o: curved(12, **o),
    "chain, sparse": lambda **o: curved(DENSE_SIZE + 20, **o),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_rate_is_quadratic(name):
    residual, slope, z0 = PROBLEMS[name]()
    result = newton(residual, slope, z0, tol=1e-13, globalize="none")
    assert rate_is_quadratic(result) and np.abs(residual(result.z)).max() <= 1e-9


@pytest.mark.parametrize("name", PROBLEMS)
def test_one_percent_too_much_slope_loses_the_rate(name):
    residual, slope, z0 = PROBLEMS[name](jacobian=1.01)
    result = newton(residual, slope, z0, tol=1e-13, globalize="none")
    assert not rate_is_quadratic(result) and rate(result) < 1.2


def test_a_dropped_term_loses_the_rate():
    residual, slope, z0 = curved(12, dropped=True)
    assert not rate_is_quadratic(newton(residual, slope, z0, tol=1e-13, globalize="none"))


def test_a_stiff_net_is_solved_at_the_quadratic_rate():
    """From nothing, and after a line search has shortened the first steps (whose window is still settling)."""
    assert rate_is_quadratic(solve_step()) and not rate_is_quadratic(solve_step(1.01))
    searched, slipped = (solve_step(scale, globalize="line_search") for scale in (1.0, 1.01))
    assert searched.corrections[-1] <= 1e-13 and rate(searched) >= 1.75 and rate(slipped) <= 1.2


# Case 5 of the hard cases: min sqrt(1 + x^2)

CASE_5 = (lambda x: x / np.hypot(1, x), lambda x: np.diag(np.hypot(1, x) ** -3.0))


def test_undamped_newton_cycles_from_one():
    """x -> -x^3."""
    result = newton(*CASE_5, [1.0], globalize="none", max_iterations=10)
    assert result.status is Status.MAX_ITERATIONS and result.iterations == 10
    assert result.z[0] == pytest.approx(1.0, abs=1e-10)  # round-off grows threefold an iteration
    assert newton(*CASE_5, [0.5], globalize="none", max_iterations=1).z[0] == pytest.approx(-(0.5**3))


def test_undamped_newton_diverges_from_one_point_one():
    result = newton(*CASE_5, [1.1], globalize="none")
    assert not result.converged and not abs(result.z[0]) < 1e3


@pytest.mark.parametrize("globalize", ["line_search", lambda x: np.hypot(1, x[0])], ids=["residual", "energy"])
@pytest.mark.parametrize("x0", [1.0, 1.1, 3.0, -1.1])
def test_a_line_search_gets_there(globalize, x0):
    result = newton(*CASE_5, [x0], tol=1e-10, globalize=globalize)
    assert result.converged and result.iterations <= 20 and abs(result.z[0]) <= 1e-12
    assert all(b <= a for a, b in zip(result.merits, result.merits[1:], strict=False))


# Energy descent


def step_problem(system, x, h=1.0):
    """One backward Euler step from rest at x, in its accelerations: residual, matrix, energy, guess."""

    def place(k):
        return x.ravel() + h * h * k, h * k

    def residual(k):
        return system.stage_residual(k, 0.0, *place(k))

    def slope(k):
        return system.stage_matrix(0.0, place(k), (h * h, h))

    energy = system.stage_energy(0.0, (h * h, h))
    assert energy is not None
    return residual, slope, (lambda k: energy(k, place(k)[0])), np.zeros(system.n)


def compressed(points):
    """Case 4: springs at half their rest length and h^2 k/m > 1, so that the matrix is indefinite."""
    x = np.stack([0.5 * np.arange(points), 0.01 * np.sin(np.arange(points))], axis=1)
    springs = Springs([(i, i + 1) for i in range(points - 1)], 1.0, 40.0)
    return step_problem(System(np.ones(points), springs, 2, fixed=(0,)), x)


def squeezed():
    """Case 4 between two walls: a mass held by two compressed springs, and gravity to push it off the line."""
    effects = (Springs([(0, 1), (1, 2)], 1.0, 40.0), Gravity([0.0, -1.0]))
    return step_problem(System(np.ones(3), effects, 2, fixed=(0, 2)), np.array([[-0.5, 0], [0, 0], [0.5, 0]]))


@pytest.mark.parametrize("points", [2, 8, DENSE_SIZE // 2 + 10])
def test_energy_falls_at_every_iteration(points):
    residual, slope, energy, z0 = compressed(points)
    matrix = slope(z0)
    dense = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    assert np.linalg.eigvalsh(dense)[0] < 0  # the case it claims to be
    seen = []

    def watched(z):
        seen.append((np.array(z), energy(z)))
        return slope(z)

    result = newton(residual, watched, z0, tol=1e-10, globalize=energy, max_iterations=300)
    energies = [value for _, value in seen] + [energy(result.z)]
    assert result.converged and np.abs(residual(result.z)).max() <= 1e-8
    fall = np.diff(energies)
    assert (fall <= 1e-13 * np.abs(energies[0])).all() and (fall[: len(fall) // 2] < 0).all()
    assert result.merits == pytest.approx(energies)


def test_without_descent_the_energy_rises():
    """The naive method: a full Newton step climbs, against gravity, and ends at the unstable balance."""
    residual, slope, energy, z0 = squeezed()
    naive = newton(residual, slope, z0, globalize="none")
    once = newton(residual, slope, z0, globalize="none", max_iterations=1)
    assert energy(once.z) > energy(z0) and once.z[3] > 0
    assert naive.converged and np.linalg.eigvalsh(slope(naive.z))[0] < 0
    descent = newton(residual, slope, z0, globalize=energy)
    assert descent.converged and np.linalg.eigvalsh(slope(descent.z))[0] > 0
    assert descent.z[3] < 0 and energy(descent.z) < energy(z0) - 1


def test_descent_keeps_the_quadratic_rate():
    """Near the minimum the matrix is definite: nothing is projected there and the last steps are full."""
    residual, slope, energy, z0 = squeezed()
    assert rate_is_quadratic(newton(residual, slope, z0, tol=1e-13, globalize=energy))

    def shifted(z):
        return slope(z) + 5.0 * np.eye(len(z))

    assert not rate_is_quadratic(newton(residual, shifted, z0, tol=1e-13, globalize=energy, max_iterations=300))


# How an iteration ends


def test_converged_at_once():
    result = newton(lambda z: z - 1, lambda z: np.eye(1), [1.0])
    assert result.converged and result.iterations == 0 and result.evaluations == 1 and result.residuals == (0.0,)


def test_a_linear_problem_takes_one_step_and_its_history_says_so():
    A, b = np.array([[3.0, 1.0], [0.0, 2.0]]), np.array([1.0, 4.0])
    result = newton(lambda z: A @ z - b, lambda z: A, np.zeros(2))
    assert result.converged and result.z == pytest.approx(np.linalg.solve(A, b)) and result.iterations <= 2
    assert len(result.residuals) == len(result.merits) == len(result.corrections) + 1
    assert result.factor is not None and result.factor.solve(b) == pytest.approx(result.z)


def test_nothing_to_solve():
    result = newton(lambda z: z, lambda z: np.zeros((0, 0)), np.zeros(0))
    assert result.converged and result.iterations == 0


ENDS = {
    Status.SINGULAR: (lambda z: z**2 + 1, lambda z: np.diag(2 * z), [0.0], "line_search"),
    Status.MAX_ITERATIONS: (lambda z: z**2 + 1, lambda z: np.diag(2 * z), [0.3], "none"),
    Status.LINE_SEARCH_FAILED: (lambda z: z**3 - 2, lambda z: np.diag(-3 * z**2), [1.0], "line_search"),
    Status.NOT_FINITE: (lambda z: np.full(1, np.nan), lambda z: np.eye(1), [1.0], "line_search"),
}


@pytest.mark.parametrize("status", ENDS)
def test_how_it_fails(status):
    residual, slope, z0, globalize = ENDS[status]
    result = newton(residual, slope, z0, globalize=globalize)
    assert result.status is status and result.status == status.value and not result.converged
    assert result.iterations <= 50 and result.z.shape == (1,)


def test_a_step_that_overflows_is_not_finite():
    steep = newton(lambda z: np.exp(z) - 1, lambda z: np.diag(np.exp(z)), [-20.0], globalize="none")
    assert steep.status is Status.NOT_FINITE
    damped = newton(lambda z: np.exp(z) - 1, lambda z: np.diag(np.exp(z)), [-20.0], max_iterations=200)
    assert damped.converged and abs(damped.z[0]) < 1e-10


def test_an_ascent_direction_is_refused():
    """An object with `.solve` is taken at its word; descent sees that its direction climbs."""

    class Uphill:
        def solve(self, b):
            return -b

    result = newton(lambda z: z, lambda z: Uphill(), [1.0], globalize=lambda z: 0.5 * float(z @ z))
    assert result.status is Status.LINE_SEARCH_FAILED and result.z == [1.0]


def test_dense_sparse_and_solver_objects_agree():
    residual, slope, z0 = curved(12)
    forms = (lambda z: slope(z).toarray(), slope, lambda z: factorize(slope(z)))
    answers = [newton(residual, form, z0).z for form in forms]
    assert np.abs(answers[0] - answers[1]).max() <= 1e-14 and np.abs(answers[0] - answers[2]).max() <= 1e-14


def test_the_start_is_not_written_to():
    z0 = np.array([3.0])
    newton(*square_root()[:2], z0)
    assert z0 == [3.0]


def test_what_tol_means():
    """The last full correction is at most tol, the one before was not; sizes are relative above 1."""
    residual, slope, z0 = square_root()
    for tol in (1e-2, 1e-5, 1e-9):
        result = newton(residual, slope, z0, tol=tol, globalize="none")
        assert result.converged and result.corrections[-1] <= tol < result.corrections[-2]
        assert np.abs(result.z - np.sqrt(2)).max() <= tol**2
    assert newton(residual, slope, z0, tol=1e-2).iterations < newton(residual, slope, z0, tol=1e-9).iterations
    large = newton(lambda z: z**2 - 1e20, lambda z: np.diag(2 * z), [3e10], tol=1e-6)
    assert large.converged and large.corrections[-1] <= 1e-6 and large.z[0] == pytest.approx(1e10, rel=1e-12)


def test_a_tolerance_below_round_off_still_ends():
    residual, slope, z0 = bratu()
    result = newton(residual, slope, z0, tol=1e-300)
    assert result.converged and result.corrections[-1] <= 1e-12


def test_a_measure_of_ones_own():
    residual, slope, z0 = square_root()
    sizes = []

    def size(dz, z):
        sizes.append(float(np.abs(dz).sum()))
        return sizes[-1]

    result = newton(residual, slope, z0, size=size, globalize="none")
    assert result.corrections == tuple(sizes)


def test_a_system_under_everything_is_solved_at_the_quadratic_rate():
    """Springs, their damping and gravity: the matrix is not symmetric, and 2 % less damping slope is seen."""
    rng = np.random.default_rng(3)
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    effects = (Gravity([0, -9.81]), Springs(pairs, 1.0, 300.0), SpringDamping(pairs, 20.0))
    system = System(np.ones(4), effects, 2, fixed=(0,))
    q0, v0, h = rng.normal(size=8), 5 * rng.normal(size=8), 0.05

    def run(slip):
        def place(k):
            return q0 + h * (v0 + h * k), v0 + h * k

        return newton(
            lambda k: system.stage_residual(k, 0.0, *place(k)),
            lambda k: system.stage_matrix(0.0, place(k), (h * h, slip * h)),
            np.zeros(8),
            tol=1e-14,
            globalize="none",
        )

    assert rate_is_quadratic(run(1.0)) and not rate_is_quadratic(run(0.98))


def test_an_overflow_that_reads_zero_is_no_solution():
    """x / sqrt(1 + x^2) from 1.1: undamped Newton runs off to where x^2 overflows and the quotient is 0."""
    result = newton(
        lambda x: x / np.sqrt(1 + x**2), lambda x: np.diag((1 + x**2) ** -1.5), np.array([1.1]), globalize="none"
    )
    assert result.status in (Status.NOT_FINITE, Status.SINGULAR) and not result.converged


@pytest.mark.parametrize("start", [1e-12, 1e-3])
def test_a_small_step_at_a_small_scale_is_no_convergence(start):
    result = newton(np.log, lambda z: np.diag(1 / z), np.array([start]), max_iterations=200)
    assert result.converged and abs(result.z[0] - 1) < 1e-9


def test_a_wrong_jacobian_that_hardly_moves_is_no_convergence():
    assert not newton(lambda z: z - 1, lambda z: 1e8 * np.eye(1), np.zeros(1)).converged
