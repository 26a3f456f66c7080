"""The softest mode of a matrix: whether a stationary point is a minimum, and how far it is from being singular."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.linear import DENSE_SIZE, Factor, Matrix, SingularMatrixError, factorize, shifted_factor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from dsim.solve.band import Band

_FIRST_SHIFT = 1e-8  # of the largest entry: what is added to an indefinite matrix first
_LOOSE, _TIGHT = 1e-2, 1e-6  # relative tolerances of Lanczos, for the largest value and for the smallest


class Mode(NamedTuple):
    """The smallest eigenvalue of a symmetric matrix, sign included; the smallest singular value of another one.

    right, left (n,): its unit vectors, equal for a symmetric matrix.  largest: the largest |eigenvalue| or singular
    value.  factor: of the matrix itself, where that had to be made and is exact.
    """

    value: float
    right: Array
    left: Array
    largest: float
    factor: Factor | None


def softest_mode(matrix: Matrix, band: Band | None, free: NDArray[np.int64], symmetric: bool) -> Mode:
    """The softest mode of the rows and columns `free`; the others must be decoupled.

    Dense by LAPACK.  Sparse by Lanczos on the inverse; an indefinite matrix is shifted until it has a Cholesky
    factor, so that the smallest eigenvalue is the one closest to the shift.
    """
    n = matrix.shape[0]
    if len(free) <= DENSE_SIZE:
        block = matrix[np.ix_(free, free)]
        value, right, left, largest = _dense(block if isinstance(block, np.ndarray) else block.toarray(), symmetric)
        factor = None
    else:
        reduced = _Reduced(matrix, band, free)
        value, right, left, largest, factor = reduced.symmetric() if symmetric else reduced.general()
    vectors = np.zeros((2, n))
    vectors[:, free] = right, left
    return Mode(value, vectors[0], vectors[1], largest, factor)


def _dense(block: Array, symmetric: bool) -> tuple[float, Array, Array, float]:
    if symmetric:
        values, vectors = np.linalg.eigh(0.5 * (block + block.T))
        return float(values[0]), vectors[:, 0], vectors[:, 0], float(np.abs(values).max())
    left, values, right = np.linalg.svd(block)
    return float(values[-1]), right[-1], left[:, -1], float(values[0])


class _Reduced:
    """A sparse matrix seen on its free rows and columns."""

    def __init__(self, matrix: Any, band: Band | None, free: NDArray[np.int64]) -> None:
        self.matrix, self.band, self.free = matrix, band, free
        self.start = np.random.default_rng(0).normal(size=len(free))  # Lanczos needs one; fixed, to repeat itself

    def operator(self, apply: Any) -> Any:
        from scipy.sparse.linalg import LinearOperator

        def product(x: Array) -> Array:
            whole = np.zeros(self.matrix.shape[0])
            whole[self.free] = np.ravel(x)
            value: Array = apply(whole)[self.free]
            return value

        return LinearOperator((len(self.free),) * 2, matvec=product, dtype=float)

    def lanczos(self, operator: Any, tol: float, **options: Any) -> tuple[float, Array]:
        """One extreme eigenvalue and its vector; the best so far where Lanczos does not settle."""
        from scipy.sparse.linalg import ArpackNoConvergence, eigsh

        try:
            values, vectors = eigsh(operator, k=1, v0=self.start, tol=tol, **options)
            return float(values[0]), vectors[:, 0]
        except ArpackNoConvergence:  # a cluster: any vector of it serves
            return np.nan, self.start / np.linalg.norm(self.start)

    def symmetric(self) -> tuple[float, Array, Array, float, Factor | None]:
        itself = self.operator(lambda x: self.matrix @ x)
        largest = abs(self.lanczos(itself, _LOOSE, which="LM")[0])
        size = float(np.abs(self.matrix.data).max())
        factor, shift = shifted_factor(self.matrix, self.band, np.full(self.matrix.shape[0], size), _FIRST_SHIFT)
        inverse = self.operator(factor.solve)
        _, vector = self.lanczos(itself, _TIGHT, sigma=-shift * size, OPinv=inverse, which="LM")
        value = float(vector @ (itself @ vector))
        return value, vector, vector, max(largest, size), factor if shift == 0.0 else None

    def general(self) -> tuple[float, Array, Array, float, Factor | None]:
        itself = self.operator(lambda x: self.matrix @ x)
        transposed = self.operator(lambda x: self.matrix.T @ x)
        largest = np.sqrt(self.lanczos(transposed @ itself, _LOOSE, which="LM")[0])
        size = float(np.abs(self.matrix.data).max())
        try:
            factor = factorize(self.matrix, self.band)
        except SingularMatrixError:
            return 0.0, self.start, self.start, size, None
        forward, back = self.operator(factor.solve), self.operator(factor.solve_transposed)
        _, right = self.lanczos(forward @ back, _TIGHT, which="LM")
        left = back @ right
        value = 1 / float(np.linalg.norm(left))
        return value, right, left * value, max(float(largest), size), factor
