"""Cholesky of symmetric band matrices, LU of those that are not definite (LAPACK); the pattern's part is done once.

Meshes numbered along their rows have narrow bands: an n x n cloth has one of 3 n numbers, and the band's dense
arithmetic outruns a general sparse factorization up to about n = 100.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

BAND_NUMBERS = 25_000_000  # entries of the largest band worth storing: 200 MB


class SingularMatrixError(ArithmeticError):
    """The matrix has no inverse to working precision."""


class NotDefiniteError(ArithmeticError):
    """The matrix is not positive definite: it has no Cholesky factor."""


class Band:
    """How the entries of a CSR pattern, symmetric, lie in LAPACK's lower band storage.

    The order of the unknowns is the given one or reverse Cuthill-McKee's, whichever has the narrower band.
    """

    def __init__(self, pattern: csr_array) -> None:
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        self.size = pattern.shape[0]
        rows = np.repeat(np.arange(self.size), np.diff(pattern.indptr))
        columns = pattern.indices.astype(np.int64)
        self.width = int(np.abs(rows - columns).max(initial=0))
        self.order = None
        order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        place = np.empty(self.size, dtype=np.int64)
        place[order] = np.arange(self.size)
        width = int(np.abs(place[rows] - place[columns]).max(initial=0))
        if width < self.width:
            self.order, self.width = order, width
            rows, columns = place[rows], place[columns]
        self._rows, self._columns = rows, columns
        self._diagonal = np.flatnonzero(rows == columns)  # in the order of the matrix's rows
        self._lower = np.flatnonzero(rows >= columns)
        self._slots = (columns * (self.width + 1) + rows - columns)[self._lower]

    @property
    def numbers(self) -> int:
        """Entries of the band storage, also the factor's."""
        return self.size * (self.width + 1)

    def raised(self, data: Array, shifts: Array) -> Array:
        """The CSR data of matrix + diag(shifts); the pattern must hold the diagonal, as a `SumPattern` does."""
        raised = data.copy()
        raised[self._diagonal] += shifts
        return raised

    def factorize(self, data: Array) -> BandFactor:
        """The Cholesky factor of the matrix with these CSR data.  Raises NotDefiniteError."""
        from scipy.linalg.lapack import dpbtrf

        if not np.isfinite(data).all():
            raise NotDefiniteError("the matrix is not finite")
        storage = np.zeros(self.numbers)
        storage[self._slots] = data[self._lower]
        lower, info = dpbtrf(storage.reshape(self.size, self.width + 1).T, lower=1, overwrite_ab=1)
        if info:
            raise NotDefiniteError(f"the leading minor of order {info} is not positive definite")
        return BandFactor(lower, self.order)

    def factorize_general(self, data: Array) -> BandLU:
        """LU with partial pivoting of the matrix with these CSR data, definite or not: four times the work.

        Raises SingularMatrixError.
        """
        from scipy.linalg.lapack import dgbtrf

        if not np.isfinite(data).all():
            raise SingularMatrixError("the matrix is not finite")
        width = self.width
        storage = np.zeros((self.size, 3 * width + 1))
        storage[self._columns, 2 * width + self._rows - self._columns] = data
        lu, exchanges, info = dgbtrf(storage.T, width, width, overwrite_ab=1)
        pivots = np.abs(lu[2 * width])
        if info or not pivots.min() > np.finfo(float).eps * pivots.max() * 1e-3:
            raise SingularMatrixError(f"pivots from {pivots.min():.1e} to {pivots.max():.1e}")
        return BandLU(lu, exchanges, width, self.order)


class BandFactor:
    """A = L L^T in band storage."""

    def __init__(self, lower: Array, order: Array | None) -> None:
        self._lower, self._order = lower, order
        self.nbytes = lower.nbytes

    def solve(self, b: Array) -> Array:
        """A^-1 b."""
        from scipy.linalg.lapack import dpbtrs

        return _ordered(b, self._order, lambda c: dpbtrs(self._lower, c, lower=1)[0])

    solve_transposed = solve


class BandLU:
    """P A = L U in band storage."""

    def __init__(self, lu: Array, exchanges: Array, width: int, order: Array | None) -> None:
        self._lu, self._exchanges, self._width, self._order = lu, exchanges, width, order
        self.nbytes = int(lu.nbytes)

    def solve(self, b: Array) -> Array:
        """A^-1 b."""
        return self._back_solve(b, 0)

    def solve_transposed(self, b: Array) -> Array:
        """A^-T b."""
        return self._back_solve(b, 1)

    def _back_solve(self, b: Array, transposed: int) -> Array:
        from scipy.linalg.lapack import dgbtrs

        lu, width, exchanges = self._lu, self._width, self._exchanges
        return _ordered(b, self._order, lambda c: dgbtrs(lu, width, width, c, exchanges, trans=transposed)[0])


def _ordered(b: Array, order: Array | None, solve: Callable[[Array], Array]) -> Array:
    """Solve in the order of the band."""
    b = np.asarray(b, dtype=float)
    if order is None:
        return solve(b).reshape(b.shape)
    x = np.empty_like(b)
    x[order] = solve(b[order]).reshape(b.shape)
    return x
