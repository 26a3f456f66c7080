"""Linear systems: one factorization, solved with the matrix and with its transpose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.band import Band, BandFactor, NotDefiniteError
from dsim.solve.band import SingularMatrixError as SingularMatrixError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Matrix = Any  # ndarray or csr_array
F = TypeVar("F")

# Below this size a dense LU beats the sparse one, index work included.
DENSE_SIZE = 128


class Factor(Protocol):
    """A factorization A = L U, or the like."""

    def solve(self, b: Array) -> Array:
        """A^-1 b."""
        ...

    def solve_transposed(self, b: Array) -> Array:
        """A^-T b."""
        ...

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        ...


class DenseFactor:
    """LU with partial pivoting (LAPACK)."""

    def __init__(self, matrix: Array) -> None:
        import warnings

        from scipy.linalg import LinAlgWarning, lapack, lu_factor

        if not np.isfinite(matrix).all():
            raise SingularMatrixError("the matrix is not finite")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LinAlgWarning)
            self._lu, self._pivots = lu_factor(matrix, check_finite=False)
        reciprocal_condition = lapack.dgecon(self._lu, np.abs(matrix).sum(axis=0).max())[0] if matrix.size else 1.0
        if not reciprocal_condition > np.finfo(float).eps:
            raise SingularMatrixError(f"reciprocal condition {reciprocal_condition:.1e}")
        self.nbytes = int(self._lu.nbytes)

    def solve(self, b: Array) -> Array:
        return self._back_solve(b, 0)

    def solve_transposed(self, b: Array) -> Array:
        return self._back_solve(b, 1)

    def _back_solve(self, b: Array, transposed: int) -> Array:
        from scipy.linalg import lu_solve

        x: Array = lu_solve((self._lu, self._pivots), b, trans=transposed, check_finite=False)
        return x


class SparseFactor:
    """LU of SuperLU."""

    def __init__(self, matrix: csr_array) -> None:
        from scipy.sparse.linalg import splu

        if not np.isfinite(matrix.data).all():
            raise SingularMatrixError("the matrix is not finite")
        try:
            self._lu = splu(matrix.tocsc())
        except RuntimeError as error:  # SuperLU's "Factor is exactly singular"
            raise SingularMatrixError(str(error)) from error
        pivots = np.abs(self._lu.U.diagonal())
        if not pivots.min() > np.finfo(float).eps * pivots.max() * 1e-3:
            raise SingularMatrixError(f"pivots from {pivots.min():.1e} to {pivots.max():.1e}")
        self.nbytes = 12 * int(self._lu.nnz)  # a number and its row

    def solve(self, b: Array) -> Array:
        x: Array = self._lu.solve(b)
        return x

    def solve_transposed(self, b: Array) -> Array:
        x: Array = self._lu.solve(b, trans="T")
        return x


def factorize(matrix: Matrix, band: Band | None = None) -> Factor:
    """Factorize a square matrix, dense or sparse; one with a band by Cholesky, by LU where it is not definite.

    Raises SingularMatrixError.
    """
    if band is not None and not isinstance(matrix, np.ndarray):
        try:
            return band.factorize(matrix.data)
        except NotDefiniteError:
            return band.factorize_general(matrix.data)
    if isinstance(matrix, np.ndarray):
        return DenseFactor(matrix)
    if matrix.shape[0] <= DENSE_SIZE:
        return DenseFactor(matrix.toarray())
    return SparseFactor(matrix)


POLISH = 1e-11  # relative residual of a solution found with another matrix's factor
_MOST = 12  # conjugate-gradient iterations after which a new factor is cheaper


@dataclass(eq=False)
class Polished:
    """Solutions with a symmetric matrix, by conjugate gradients preconditioned with the factor of one close by.

    The factor guides, the matrix decides: |A x - b| <= tol |b|, or the matrix is factorized after all.
    """

    matrix: csr_array
    band: Band
    near: BandFactor
    tol: float = POLISH
    anew: Factor | None = None  # the factor made where the one close by did not serve

    def solve(self, b: Array) -> Array:
        """A^-1 b."""
        from scipy.sparse.linalg import LinearOperator, cg

        if self.anew is not None:
            return self.anew.solve(b)
        if b.ndim == 2:
            return np.stack([self.solve(column) for column in b.T], axis=1)
        guide = LinearOperator(self.matrix.shape, matvec=self.near.solve, dtype=float)
        x: Array = cg(self.matrix, b, rtol=0.1 * self.tol, maxiter=_MOST, M=guide)[0]
        if np.linalg.norm(self.matrix @ x - b) <= self.tol * np.linalg.norm(b):
            return x
        self.anew = factorize(self.matrix, self.band)
        return self.anew.solve(b)

    solve_transposed = solve

    @property
    def nbytes(self) -> int:
        return int(self.matrix.data.nbytes) + (self.near if self.anew is None else self.anew).nbytes


def make_definite(matrix: Matrix) -> Matrix:
    """The matrix itself when it is positive definite, else a positive definite one close to it.

    Dense: eigenvalues below a floor are replaced by their absolute value or the floor.  Sparse: the
    diagonal is raised, eightfold each try, until an LDL^T without pivoting has positive pivots only.
    Only Newton's search direction may use this; a linearization never does.
    Raises SingularMatrixError when the matrix is not finite.
    """
    if not np.isfinite(matrix if isinstance(matrix, np.ndarray) else matrix.data).all():
        raise SingularMatrixError("the matrix is not finite")
    if not isinstance(matrix, np.ndarray) and matrix.shape[0] <= DENSE_SIZE:
        matrix = matrix.toarray()
    if isinstance(matrix, np.ndarray):
        symmetric = 0.5 * (matrix + matrix.T)
        values, vectors = np.linalg.eigh(symmetric)
        floor = 1e-8 * max(float(np.abs(values).max(initial=0.0)), np.finfo(float).tiny)
        if values.min(initial=np.inf) > floor:
            return symmetric
        definite: Array = (vectors * np.maximum(np.abs(values), floor)) @ vectors.T
        return definite
    return _raise_diagonal(matrix)


def _raise_diagonal(matrix: csr_array) -> csr_array:
    from scipy.sparse import csr_array, diags_array

    def raised(shift: float) -> csr_array:
        return csr_array(matrix + shift * diags_array(scale))

    scale = _shares(matrix)
    return raised(_enough(lambda shift: DefiniteFactor(raised(shift)))[1])


def _shares(matrix: csr_array) -> Array:
    """What a shift of 1 adds to each diagonal entry.

    A row's share is at least a thousandth of its sum: a zero on the diagonal must be raised too, and in the end
    the diagonal dominates.
    """
    rows = np.asarray(abs(matrix).sum(axis=1))
    shares: Array = np.maximum(np.abs(matrix.diagonal()), np.maximum(1e-3 * rows, 1e-8 * rows.max() or 1.0))
    return shares


def _enough(factor: Callable[[float], F], first: float = 1e-3) -> tuple[F, float]:
    """The factor of the first shift from 0, `first`, 8 `first`, ... that makes the matrix definite, and the shift."""
    shift = 0.0
    while True:
        try:
            return factor(shift), shift
        except NotDefiniteError:
            shift = max(8.0 * shift, first)


class DefiniteFactor:
    """LDL^T of a symmetric sparse matrix, by SuperLU without row exchanges.  Raises NotDefiniteError.

    Sylvester's law: it has as many negative pivots as the matrix has negative eigenvalues.
    """

    def __init__(self, matrix: csr_array) -> None:
        from scipy.sparse.linalg import splu

        options = {"SymmetricMode": True}
        try:
            lu: Any = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        except RuntimeError as error:  # exactly singular
            raise NotDefiniteError(str(error)) from error
        if not (lu.perm_r == lu.perm_c).all() or not (lu.U.diagonal() > 0).all():
            raise NotDefiniteError("a pivot is not positive")
        self._lu = lu
        self.nbytes = 12 * int(lu.nnz)

    def solve(self, b: Array) -> Array:
        x: Array = self._lu.solve(b)
        return x

    solve_transposed = solve


def factorize_definite(matrix: Matrix, band: Band | None = None) -> Factor:
    """The factor of the matrix when it is positive definite, else of a definite one, made as `make_definite` does.

    For descents of many iterations: a sparse matrix is shifted from a tenth of that function's first shift on, and
    factorized in its band.  Raises SingularMatrixError when the matrix is not finite.
    """
    if isinstance(matrix, np.ndarray) or matrix.shape[0] <= DENSE_SIZE:
        return factorize(make_definite(matrix))
    if not np.isfinite(matrix.data).all():
        raise SingularMatrixError("the matrix is not finite")
    return shifted_factor(matrix, band, _shares(matrix), first=1e-4)[0]


def shifted_factor(matrix: csr_array, band: Band | None, shares: Array, first: float) -> tuple[Factor, float]:
    """The factor of matrix + s diag(shares), and s: the first of 0, `first`, 8 `first`, ... that makes it definite."""
    from scipy.sparse import csr_array, diags_array

    if band is None:
        return _enough(lambda s: DefiniteFactor(csr_array(matrix + s * diags_array(shares))), first)
    return _enough(lambda s: band.factorize(band.raised(matrix.data, s * shares)), first)
