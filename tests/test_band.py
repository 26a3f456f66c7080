"""Band matrices, sums with a fixed pattern, directions polished with another matrix's factor."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.sparse import coo_array, csc_array, csr_array, diags_array, eye_array, random_array

from dsim import System, adjoint, simulate
from dsim.arrays.scatter import ElementScatter, diagonal
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.kernels.spring import both_ends, both_pairs
from dsim.simulation import record
from dsim.solve import linear
from dsim.solve.band import Band, BandFactor, BandLU, NotDefiniteError, SingularMatrixError
from dsim.solve.linear import DENSE_SIZE, Polished, factorize
from dsim.solve.patterns import SumPattern
from dsim.steppers import BDF2, BackwardEuler, ImplicitMidpoint, Trapezoidal, TwoStepBackwardEuler, stage


def net(rows=7, columns=8, effects=(), slack=1.0, seed=0):
    """A cloth in general position, pinned at two corners; more unknowns than a dense matrix is used for."""
    rng = np.random.default_rng(seed)
    index = np.arange(rows * columns).reshape(rows, columns)
    pairs = np.concatenate(
        [np.stack([a.ravel(), b.ravel()], axis=1) for a, b in [
            (index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:]),
        ]]
    )  # fmt: skip
    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
    q = np.hstack([grid, np.zeros((len(grid), 1))]) + 0.05 * rng.normal(size=(len(grid), 3))
    length = np.linalg.norm(q[pairs[:, 1]] - q[pairs[:, 0]], axis=1)
    springs = Springs(pairs, slack * length, rng.uniform(20.0, 60.0, len(pairs)))
    system = System(rng.uniform(0.5, 1.5, len(q)), [springs, Gravity([0, 0, -9.8]), *effects], fixed=[0, columns - 1])
    assert system.n > DENSE_SIZE
    return system, np.concatenate([q.ravel(), 0.1 * rng.normal(size=q.size)])


def plain_stage_matrix(system, q, v, b, c):
    """M - b K - c D by the definition, dense."""
    matrix = np.diag(system.masses) - b * system.dq(0.0, q, v).toarray() - c * system.dv(0.0, q, v).toarray()
    pinned = system.free == 0
    matrix[pinned] = matrix[:, pinned] = 0.0
    matrix[pinned, pinned] = system.masses[pinned]
    return matrix


# Edges


def test_edge_scatters_equal_those_of_both_ends():
    rng = np.random.default_rng(3)
    scatter = ElementScatter(np.array([[0, 1], [2, 1], [3, 0], [1, 3]]), 4, 2)
    values, blocks = rng.normal(size=(4, 2)), rng.normal(size=(4, 2, 2))
    assert np.allclose(scatter.edge_vector(values), scatter.vector(both_ends(values)), rtol=0, atol=1e-14)
    made, plain = scatter.edge_matrix(blocks), scatter.matrix(both_pairs(blocks))
    assert np.array_equal(made.indices, plain.indices)
    assert np.allclose(made.data, plain.data, rtol=0, atol=1e-14)
    q = rng.normal(size=8)
    ends = scatter.gather(q)
    assert np.array_equal(scatter.edges(q), ends[:, 1] - ends[:, 0])


# Sums


def test_a_sum_with_a_fixed_pattern_is_the_sum():
    rng = np.random.default_rng(0)
    a, b = (csr_array(random_array((9, 9), density=0.3, rng=rng, format="csr")) for _ in range(2))
    free = np.ones(9)
    free[[2, 5]] = 0.0
    pinned = (1 - free) * 7.0
    total = SumPattern([a, b], free).total([2.0, -3.0], [a, b], pinned)
    keep = np.diag(free)
    assert np.allclose(total.toarray(), keep @ (2 * a - 3 * b).toarray() @ keep + np.diag(pinned), atol=1e-14)


def test_repeated_entries_are_added():
    doubled = csr_array((np.array([1.0, 2.0, 4.0]), np.array([1, 1, 0]), np.array([0, 2, 3])), shape=(2, 2))
    total = SumPattern([doubled], np.ones(2)).total([1.0], [doubled], np.zeros(2))
    assert np.array_equal(total.toarray(), [[0.0, 3.0], [4.0, 0.0]])


def test_another_pattern_is_noticed():
    a, other = diagonal(np.ones(3)), csr_array(np.triu(np.ones((3, 3))))
    pattern = SumPattern([a], np.ones(3))
    assert pattern.fits([diagonal(np.full(3, 2.0))])
    assert not pattern.fits([other])
    assert not pattern.fits([a, a])


@pytest.mark.parametrize("effects", [(), (Drag(0.3),), (SpringDamping([[0, 9], [3, 4]], 0.7),)])
def test_the_stage_matrix_is_its_definition(effects):
    system, y0 = net(effects=effects)
    q, v = system.blocks(y0)
    for b, c in ((0.1, 0.2), (0.3, 0.0)):
        matrix = system.stage_matrix(0.0, (q, v), (b, c))
        assert np.allclose(matrix.toarray(), plain_stage_matrix(system, q, v, b, c), rtol=0, atol=1e-12)


def test_only_symmetric_matrices_are_given_a_band():
    for effects, there in (((), True), ((Drag(0.3),), True), ((SpringDamping([[0, 9]], 0.7),), False)):
        system, y0 = net(effects=effects)
        system.stage_matrix(0.0, system.blocks(y0), (0.1, 0.2))
        assert (system.stage_band((0.1, 0.2)) is not None) == there


def test_too_wide_a_band_is_not_stored(monkeypatch):
    monkeypatch.setattr("dsim.solve.patterns.BAND_NUMBERS", 10)
    system, y0 = net()
    system.stage_matrix(0.0, system.blocks(y0), (0.1, 0.2))
    assert system.stage_band((0.1, 0.2)) is None


# Factors


def banded(n=40, shuffle=False):
    """A definite band matrix, perhaps with its unknowns shuffled."""
    matrix = diags_array([-1.0, -2.0, 7.0, -2.0, -1.0], offsets=(-4, -1, 0, 1, 4), shape=(n, n)).tocsr()
    order = np.random.default_rng(1).permutation(n) if shuffle else np.arange(n)
    return csr_array(matrix[order][:, order])


@pytest.mark.parametrize("shuffle", [False, True])
def test_band_factors_solve(shuffle):
    matrix = banded(shuffle=shuffle)
    band, b = Band(matrix), np.random.default_rng(0).normal(size=40)
    assert band.width <= 8  # Cuthill-McKee finds the band again
    for factor in (band.factorize(matrix.data), band.factorize_general(matrix.data)):
        assert np.abs(matrix @ factor.solve(b) - b).max() < 1e-13
        assert np.abs(matrix.T @ factor.solve_transposed(b) - b).max() < 1e-13
        block = np.stack([b, 2 * b], axis=1)
        assert np.abs(matrix @ factor.solve(block) - block).max() < 1e-13


def test_indefinite_matrices_get_an_lu_and_singular_ones_an_error():
    matrix = csr_array(banded() - 6.0 * eye_array(40))
    assert np.linalg.eigvalsh(matrix.toarray()).min() < 0
    band, b = Band(matrix), np.ones(40)
    with pytest.raises(NotDefiniteError, match="leading minor"):
        band.factorize(matrix.data)
    factor = factorize(matrix, band)
    assert isinstance(factor, BandLU)
    assert np.abs(matrix @ factor.solve(b) - b).max() < 1e-12
    for data in (0 * matrix.data, np.full_like(matrix.data, np.nan)):
        with pytest.raises(SingularMatrixError):
            factorize(csr_array((data, matrix.indices, matrix.indptr)), band)


def test_polishing_answers_for_the_matrix_and_not_for_the_factor():
    near, matrix = banded(), csr_array(banded() + diagonal(np.linspace(0, 0.2, 40)))
    band, b = Band(matrix), np.ones(40)
    polished = Polished(matrix, band, band.factorize(near.data))
    assert np.linalg.norm(matrix @ polished.solve(b) - b) <= 1e-11 * np.linalg.norm(b)
    assert polished.anew is None


def test_a_factor_that_is_too_far_is_replaced():
    matrix = banded()
    band, b = Band(matrix), np.random.default_rng(0).normal(size=40)
    far = band.factorize(csr_array(matrix + diagonal(np.linspace(0, 1e6, 40))).data)
    polished = Polished(matrix, band, far)
    assert np.linalg.norm(matrix @ polished.solve(b) - b) <= 1e-11 * np.linalg.norm(b)
    assert isinstance(polished.anew, BandFactor)


def test_a_wrong_polish_would_be_seen(monkeypatch):
    """Mutation: without the check of the residual the far factor's answer would pass."""
    monkeypatch.setattr(linear, "_MOST", 1)
    matrix = banded()
    band, b = Band(matrix), np.random.default_rng(0).normal(size=40)
    far = band.factorize(csr_array(matrix + diagonal(np.linspace(0, 1e6, 40))).data)
    careless = Polished(matrix, band, far, tol=np.inf)
    assert np.linalg.norm(matrix @ careless.solve(b) - b) > 1e-3 * np.linalg.norm(b)


# Runs: the fast path against the plain one

METHODS = [BackwardEuler(), TwoStepBackwardEuler(), ImplicitMidpoint(), Trapezoidal(), BDF2()]


def both_ways(monkeypatch, method, system, y0):
    """Trajectories and gradients with the band and with general sparse LU."""
    h, steps = 0.05, 4
    load = np.zeros((steps + 1, system.size))
    load[-1] = np.random.default_rng(5).normal(size=system.size)
    fast = simulate(method, system, y0, h, steps, keep="factors")
    gradient = adjoint(fast, load)
    with monkeypatch.context() as patch:
        patch.setattr(System, "stage_band", lambda self, weights: None)
        plain = simulate(method, system, y0, h, steps)
        return fast, gradient, plain, adjoint(plain, load)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("slack", [0.8, 1.3], ids=["stretched", "compressed"])
def test_band_runs_equal_plain_runs(monkeypatch, method, slack):
    system, y0 = net(slack=slack, effects=(Drag(0.1),))
    fast, gradient, plain, expected = both_ways(monkeypatch, method, system, y0)
    assert np.abs(fast.y - plain.y).max() < 1e-9
    assert np.abs(gradient.theta - expected.theta).max() < 1e-7 * np.abs(expected.theta).max()
    assert np.abs(gradient.y0 - expected.y0).max() < 1e-7 * np.abs(expected.y0).max()
    assert fast.counters.factorizations <= fast.counters.newton_iterations
    assert plain.counters.factorizations == plain.counters.newton_iterations


def test_kept_factors_serve_the_way_back(monkeypatch):
    """No factorization on the way back where the steps kept theirs; without them there is one a step."""
    system, y0 = net(slack=0.8)
    kept, states = (simulate(BackwardEuler(), system, y0, 0.05, 5, keep=keep) for keep in ("factors", "steps"))
    assert all(s.factor_bytes > 0 for s in kept.steps)
    made = []
    original = Band.factorize
    monkeypatch.setattr(Band, "factorize", lambda *a: made.append(1) or original(*a))
    adjoint(kept, np.ones((6, system.size)))
    assert not made
    adjoint(states, np.ones((6, system.size)))
    assert len(made) == 5


def test_factors_stay_within_their_budget(monkeypatch):
    system, y0 = net(slack=0.8)
    size = simulate(BackwardEuler(), system, y0, 0.05, 1, keep="factors").steps[0].factor_bytes
    monkeypatch.setattr("dsim.simulation.FACTOR_BYTES", 2 * size)
    run = simulate(BackwardEuler(), system, y0, 0.05, 5, keep="factors")
    assert [s.factor_bytes for s in run.steps] == [size, size, 0, 0, 0]
    assert all(s.factors is None for s in simulate(BackwardEuler(), system, y0, 0.05, 2, keep="steps").steps)


# Counts


def test_one_pattern_a_run(monkeypatch):
    system, y0 = net(effects=(Drag(0.1),))
    made = []
    original = SumPattern.__init__
    monkeypatch.setattr(SumPattern, "__init__", lambda self, *a: made.append(1) or original(self, *a))
    run = simulate(BackwardEuler(), system, y0, 0.05, 5, keep="factors")
    adjoint(run, np.ones((6, system.size)))
    record(BackwardEuler(), system.with_theta(system.theta * 1.01), y0, 0.05, 2)
    assert len(made) == 1


def test_an_iteration_makes_at_most_one_factor(monkeypatch):
    """Counted at the source, not by the counters; and near iterates share one."""
    system, y0 = net(slack=0.8)
    made = []
    for name in ("factorize", "factorize_general"):
        original = getattr(Band, name)
        monkeypatch.setattr(Band, name, lambda *a, original=original: made.append(1) or original(*a))
    counters = simulate(BackwardEuler(), system, y0, 0.05, 5).counters
    assert len(made) == counters.factorizations < counters.newton_iterations


def test_the_counters_see_factors_made_while_polishing(monkeypatch):
    """With every iterate called near, polishing fails for the far ones and factorizes: that counts."""
    monkeypatch.setattr(stage, "_NEAR", 1e9)
    monkeypatch.setattr(linear, "_MOST", 1)
    system, y0 = net(slack=0.8)
    made = []
    original = Band.factorize
    monkeypatch.setattr(Band, "factorize", lambda *a: made.append(1) or original(*a))
    run = simulate(BackwardEuler(), system, y0, 0.05, 3)
    assert 3 < len(made) == run.counters.factorizations <= run.counters.newton_iterations


# Effects as users write them


class Pull:
    """Linear: f = A q on the degrees of freedom, with the matrix in any form."""

    name = "pull"

    def __init__(self, matrix, form=csr_array):
        self.matrix, self.form = matrix, form

    def force(self, t, q, v):
        return self.matrix @ q

    def dq(self, t, q, v):
        return self.form(self.matrix)


def leaning(n):
    return diags_array([1.0, -3.0, 2.0], offsets=(-1, 0, 1), shape=(n, n)).toarray()


def gradient_and_difference(system, y0, h=0.1, steps=3):
    """dJ/dy0 of the sum of the last state along one direction, and its central difference."""
    way = np.random.default_rng(2).normal(size=y0.size)

    def end(y):
        return simulate(BackwardEuler(), system, y, h, steps).last.sum()

    run = simulate(BackwardEuler(), system, y0, h, steps, keep="factors")
    found = adjoint(run, np.ones(system.size)).y0 @ way
    return found, (end(y0 + 1e-5 * way) - end(y0 - 1e-5 * way)) / 2e-5


@pytest.mark.parametrize("n", [20, DENSE_SIZE, DENSE_SIZE + 1, 150])
@pytest.mark.parametrize("form", [csr_array, csc_array, coo_array, np.asarray])
def test_a_jacobian_may_come_in_any_form(n, form):
    system = System(np.ones(n), Pull(leaning(n), form), 1)
    found, expected = gradient_and_difference(system, np.random.default_rng(0).normal(size=2 * n))
    assert found == pytest.approx(expected, rel=1e-6)


def test_a_jacobian_of_another_shape_is_named():
    system = System(np.ones(4), Pull(np.eye(4), lambda matrix: csr_array(matrix[:3])), 1)
    with pytest.raises(ValueError, match=r"dq of 'pull' must return shape \(4, 4\); got \(3, 4\)"):
        simulate(BackwardEuler(), system, np.ones(8), 0.1, 1)


class Follower(Gravity):
    """Inherits `symmetric` from a force without derivatives, and has an unsymmetric one."""

    def force(self, t, q, v):
        return leaning(len(q)) @ q

    def dq(self, t, q, v):
        return csr_array(leaning(len(q)))


class Boaster(Pull):
    symmetric = True  # which it is not


@pytest.mark.parametrize("n", [40, 160])
def test_symmetry_is_neither_inherited_nor_believed(n):
    for effect in (Follower([1.0]), Boaster(leaning(n))):
        system = System(np.ones(n), effect, 1)
        found, expected = gradient_and_difference(system, np.random.default_rng(0).normal(size=2 * n))
        assert found == pytest.approx(expected, rel=1e-6)
        system.stage_matrix(0.0, (np.ones(n), np.ones(n)), (0.1, 0.1))
        assert system.stage_band((0.1, 0.1)) is None


def test_an_effect_that_says_nothing_is_not_symmetric():
    n = 150
    system = System(np.ones(n), Pull(-np.eye(n)), 1)
    system.stage_matrix(0.0, (np.ones(n), np.ones(n)), (0.1, 0.1))
    assert system.stage_band((0.1, 0.1)) is None


def test_only_the_derivatives_in_use_decide_about_symmetry():
    """Spring damping's dv is symmetric at no weight: with weight 0 it is not asked."""
    n = 150
    lean = Pull(leaning(n))
    lean.dv, lean.dq = lean.dq, None
    system = System(np.ones(n), lean, 1)
    for weights, there in (((0.1, 0.0), True), ((0.1, 0.1), False)):
        system.stage_matrix(0.0, (np.ones(n), np.ones(n)), weights)
        assert (system.stage_band(weights) is not None) == there


def test_effects_need_not_be_hashable():
    @dataclass
    class Wind(Pull):
        matrix: np.ndarray
        form: object = csr_array

    n = DENSE_SIZE + 1
    system = System(np.ones(n), Wind(-np.eye(n)), 1)
    assert simulate(BackwardEuler(), system, np.ones(2 * n), 0.1, 2).y.shape == (3, 2 * n)


def test_systems_with_other_pins_have_patterns_of_their_own():
    system, y0 = net()
    system.stage_matrix(0.0, system.blocks(y0), (0.1, 0.2))
    other = dataclasses.replace(system, fixed=[5])
    matrix = other.stage_matrix(0.0, other.blocks(y0), (0.1, 0.2))
    assert np.allclose(matrix.toarray(), plain_stage_matrix(other, *other.blocks(y0), 0.1, 0.2), rtol=0, atol=1e-12)


def test_a_pattern_that_moves_is_followed():
    """New columns, new rows, and the same arrays with other contents."""
    n, state = 150, {"shift": 1}
    indices, indptr = np.arange(n, dtype=np.int32), np.arange(n + 1, dtype=np.int32)

    class Moving:
        name = "moving"

        def force(self, t, q, v):
            return np.zeros(n)

        def dq(self, t, q, v):
            indices[:] = (np.arange(n) + state["shift"]) % n
            matrix = csr_array((n, n))
            matrix.data, matrix.indices, matrix.indptr = np.ones(n), indices, indptr
            return matrix

    system = System(np.ones(n), Moving(), 1)
    for state["shift"] in (1, 2, 0):
        matrix = system.stage_matrix(0.0, (np.ones(n), np.ones(n)), (0.5, 0.0)).toarray()
        assert np.array_equal(matrix, np.eye(n) - 0.5 * np.roll(np.eye(n), state["shift"], axis=1))
    rows = [csr_array((np.ones(2), np.array([0, 1]), np.array(p)), shape=(2, 2)) for p in ([0, 1, 2], [0, 2, 2])]
    assert not SumPattern(rows[:1], np.ones(2)).fits(rows[1:])


def test_shared_indices_cannot_be_changed():
    system, y0 = net()
    matrix = system.stage_matrix(0.0, system.blocks(y0), (0.1, 0.2))
    for shared in (matrix, diagonal(np.ones(5)), system.effects[0].dq(0.0, *system.blocks(y0))):
        assert not shared.indices.flags.writeable and not shared.indptr.flags.writeable
    diagonal(system.masses).data *= 7.0
    assert np.array_equal(system.masses, np.repeat(system.mass, 3))


def test_an_infinite_slope_at_a_pin_is_cleared():
    slope = Pull(np.zeros((4, 4)), lambda matrix: csr_array(np.diag([np.inf, -1.0, -1.0, -1.0])))
    system = System(np.ones(4), slope, 1, fixed=[0])
    matrix = system.stage_matrix(0.0, (np.ones(4), np.ones(4)), (0.5, 0.0))
    assert np.array_equal(matrix, np.diag([1.0, 1.5, 1.5, 1.5]))


def test_compressed_nets_use_both_factors(monkeypatch):
    """Definite and indefinite matrices in one run: equal to the plain path, and an LU preconditions nothing."""
    system, y0 = net(slack=1.1)
    made = []
    for name in ("factorize", "factorize_general"):
        original = getattr(Band, name)

        def counted(self, data, original=original, name=name):
            factor = original(self, data)
            made.append(name)
            return factor

        monkeypatch.setattr(Band, name, counted)
    run = simulate(BackwardEuler(), system, y0, 0.15, 6, keep="factors")
    assert {"factorize", "factorize_general"} <= set(made) and len(made) == run.counters.factorizations
    assert all(isinstance(f, BandFactor | None) for s in run.steps for f in s.factors.values())
    monkeypatch.setattr(System, "stage_band", lambda self, weights: None)
    assert np.abs(run.y - simulate(BackwardEuler(), system, y0, 0.15, 6).y).max() < 1e-8


def test_an_unsymmetric_band_is_solved_both_ways():
    matrix = csr_array(leaning(30))
    factor, b = Band(matrix).factorize_general(matrix.data), np.arange(30)
    assert np.abs(matrix @ factor.solve(b) - b).max() < 1e-11
    assert np.abs(matrix.T @ factor.solve_transposed(b) - b).max() < 1e-11


def test_tiny_pivots_are_singular():
    matrix = banded()
    matrix.data[matrix.indices == 39] *= 1e-25
    with pytest.raises(SingularMatrixError, match="pivots from"):
        Band(banded()).factorize_general(matrix.data)


def test_polished_solves_columns_and_keeps_its_new_factor(monkeypatch):
    matrix = banded()
    band, b = Band(matrix), np.random.default_rng(0).normal(size=(40, 3))
    near = Polished(matrix, band, band.factorize(matrix.data))
    assert np.abs(matrix @ near.solve(b) - b).max() < 1e-9
    far = Polished(matrix, band, band.factorize(csr_array(matrix + diagonal(np.linspace(0, 1e6, 40))).data))
    made, original = [], Band.factorize
    monkeypatch.setattr(Band, "factorize", lambda *a: made.append(1) or original(*a))
    for column in b.T:
        far.solve(column)
    assert len(made) == 1
