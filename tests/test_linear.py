"""Factorizations, their transposes, singular matrices, and definiteness made by force."""

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array, eye_array

from dsim.solve.linear import (
    DENSE_SIZE,
    DenseFactor,
    SingularMatrixError,
    SparseFactor,
    factorize,
    make_definite,
)

LARGE = DENSE_SIZE + 40


def unsymmetric(n, seed=0):
    """A well-conditioned sparse matrix without symmetry."""
    rng = np.random.default_rng(seed)
    bands = [rng.normal(size=n - abs(k)) for k in (-3, -1, 1, 2)]
    return csr_array(diags_array(bands, offsets=(-3, -1, 1, 2)) + 8.0 * eye_array(n))


def laplacian(n, shift=0.0):
    """The chain's stiffness plus a shift: eigenvalues between shift and 4 + shift."""
    return csr_array(diags_array([-1.0, 2.0, -1.0], offsets=(-1, 0, 1), shape=(n, n)) + shift * eye_array(n))


def check_factor(factor, matrix):
    """Solutions with the matrix and with its transpose, of one and of several right sides."""
    dense = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    rng = np.random.default_rng(1)
    for b in (rng.normal(size=len(dense)), rng.normal(size=(len(dense), 3))):
        assert np.abs(dense @ factor.solve(b) - b).max() <= 1e-12
        assert np.abs(dense.T @ factor.solve_transposed(b) - b).max() <= 1e-12


@pytest.mark.parametrize("n", [1, 5, LARGE])
def test_dense_and_sparse_factors_solve_both_ways(n):
    matrix = unsymmetric(n) if n > 3 else csr_array([[2.0]])
    check_factor(DenseFactor(matrix.toarray()), matrix)
    check_factor(SparseFactor(matrix), matrix)
    check_factor(factorize(matrix), matrix)


def test_the_size_decides_how_a_sparse_matrix_is_factorized():
    assert isinstance(factorize(unsymmetric(DENSE_SIZE)), DenseFactor)
    assert isinstance(factorize(unsymmetric(DENSE_SIZE + 1)), SparseFactor)
    assert isinstance(factorize(unsymmetric(LARGE).toarray()), DenseFactor)


def test_pivoting_is_not_forgotten():
    """A zero on the diagonal is no reason to fail."""
    swap = np.array([[0.0, 1.0], [2.0, 0.0]])
    check_factor(DenseFactor(swap), swap)
    check_factor(SparseFactor(csr_array(swap)), swap)


def test_the_check_sees_a_forgotten_transpose():
    class Forgetful(DenseFactor):
        def solve_transposed(self, b):
            return self.solve(b)

    matrix = unsymmetric(5).toarray()
    with pytest.raises(AssertionError):
        check_factor(Forgetful(matrix), matrix)
    check_factor(Forgetful(matrix + matrix.T), matrix + matrix.T)  # symmetry would have hidden it


def singular_matrices(n):
    matrix = laplacian(n).toarray()
    matrix[0, 0] = matrix[-1, -1] = 1.0  # a free chain: the constant vector is in the kernel
    zero_row = unsymmetric(n).toarray()
    zero_row[1] = 0.0
    return {
        "a free chain": matrix,
        "a row of zeros": zero_row,
        "all zeros": np.zeros((n, n)),
        "not a number": np.where(np.eye(n) > 0, np.nan, 0.0),
        "infinite": np.where(np.eye(n) > 0, np.inf, 0.0),
        "a rounding away from singular": matrix + 1e-17 * np.eye(n),
    }


@pytest.mark.parametrize("name", singular_matrices(3))
@pytest.mark.parametrize("n", [6, LARGE])
def test_singular_matrices_are_named_so(name, n):
    matrix = singular_matrices(n)[name]
    for attempt in (lambda: factorize(matrix), lambda: factorize(csr_array(matrix)), lambda: DenseFactor(matrix)):
        with pytest.raises(SingularMatrixError):
            attempt()


@pytest.mark.parametrize("scale", [1e-200, 1e-12, 1.0, 1e12, 1e200])
def test_units_do_not_make_a_matrix_singular(scale):
    for n in (5, LARGE):
        for matrix in (scale * laplacian(n, 0.1), scale * laplacian(n, 0.1).toarray()):
            x = factorize(matrix).solve(scale * np.ones(n))
            assert np.abs(laplacian(n, 0.1) @ x - 1).max() <= 1e-12


def test_an_ill_conditioned_matrix_is_not_singular():
    for n in (5, LARGE):
        diagonal = np.geomspace(1e-10, 1.0, n)
        for matrix in (np.diag(diagonal), csr_array(np.diag(diagonal))):
            assert factorize(matrix).solve(diagonal) == pytest.approx(np.ones(n))


# make_definite


def lowest(matrix):
    dense = matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
    return np.linalg.eigvalsh(dense)[0]


@pytest.mark.parametrize("n", [5, LARGE])
def test_a_definite_matrix_is_left_alone(n):
    sparse = laplacian(n, 0.1)
    for matrix in (sparse, sparse.toarray()):
        made = make_definite(matrix)
        assert np.array_equal(made if isinstance(made, np.ndarray) else made.toarray(), sparse.toarray())


@pytest.mark.parametrize("shift", [-0.5, -1.9, -3.0, -4.5])
@pytest.mark.parametrize("n", [5, LARGE])
def test_an_indefinite_matrix_becomes_definite(n, shift):
    sparse = laplacian(n, shift)
    assert lowest(sparse) < 0
    for matrix in (sparse, sparse.toarray()):
        made = make_definite(matrix)
        assert lowest(made) > 0
        assert np.abs(made - made.T).max() <= 1e-12
        assert np.abs(made - sparse).max() <= 100  # close to it: not a multiple of everything
        factorize(made)


def test_dense_eigenvalues_are_turned_up():
    """Negative ones change their sign, tiny ones are lifted to a floor, the others stay."""
    vectors = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))[0]
    made = make_definite(vectors @ np.diag([3.0, -2.0, 0.0, 1.0]) @ vectors.T)
    assert np.linalg.eigvalsh(made) == pytest.approx([3e-8, 1.0, 2.0, 3.0], abs=1e-12)


def test_a_zero_diagonal_is_raised_too():
    """Off-diagonal blocks alone: half of the eigenvalues are negative and no diagonal entry gives a scale."""
    n = LARGE
    matrix = laplacian(n).toarray()
    matrix[1::2, 1::2] = 0.0
    assert lowest(matrix) < 0 and lowest(make_definite(csr_array(matrix))) > 0
    hollow = csr_array(diags_array([1.0, 1.0], offsets=(-1, 1), shape=(n, n)))
    assert lowest(make_definite(hollow)) > 0
    assert lowest(make_definite(csr_array((n, n)))) > 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_cannot_be_made_definite(value):
    for n in (5, LARGE):
        matrix = laplacian(n)
        matrix.data[3] = value
        for form in (matrix, matrix.toarray()):
            with pytest.raises(SingularMatrixError, match="not finite"):
                make_definite(form)


def test_only_the_symmetric_part_counts_in_the_dense_case():
    turned = np.array([[2.0, 1.0], [-1.0, 2.0]])
    assert np.array_equal(make_definite(turned), 2 * np.eye(2))
