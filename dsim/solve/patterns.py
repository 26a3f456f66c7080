"""Sums of sparse matrices whose patterns stay the same: where every entry goes is found once, then only data moves."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.band import BAND_NUMBERS, Band

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class SumPattern:
    """The union of the patterns of CSR matrices (n,n), the diagonal included, and the way of their entries into it.

    free (n,): rows and columns where it is 0 are cleared, as far as the diagonal; `pinned` (n,) stands there instead.
    """

    def __init__(self, matrices: Sequence[csr_array], free: Array) -> None:
        from scipy.sparse import csr_array

        n = len(free)
        codes = [_codes(matrix) for matrix in matrices]
        diagonal = np.arange(n) * (n + 1)
        places = np.unique(np.concatenate([*codes, diagonal]))
        indptr = np.concatenate([[0], np.cumsum(np.bincount(places // n, minlength=n))]).astype(np.int32)
        shape = (n, n)
        self.pattern = csr_array((np.zeros(len(places)), (places % n).astype(np.int32), indptr), shape=shape)
        self._sources = [(_kept(matrix.indptr), _kept(matrix.indices)) for matrix in matrices]
        self._ways = [_way(np.searchsorted(places, code), len(places)) for code in codes]
        self._diagonal = np.searchsorted(places, diagonal)
        self._cleared = np.flatnonzero(free[places // n] * free[places % n] == 0)
        self.symmetric: bool | None = None  # of the first sum, to a relative 1e-10
        for indices in (self.pattern.indices, self.pattern.indptr):
            indices.setflags(write=False)  # shared by every sum

    @cached_property
    def band(self) -> Band | None:
        """Its band, where that is worth storing."""
        band = Band(self.pattern)
        return band if band.numbers <= BAND_NUMBERS else None

    def fits(self, matrices: Sequence[csr_array]) -> bool:
        """Whether these matrices have the patterns this sum was made for."""
        if len(matrices) != len(self._sources):
            return False
        return all(
            _same(matrix.indices, indices) and _same(matrix.indptr, indptr)
            for matrix, (indptr, indices) in zip(matrices, self._sources, strict=True)
        )

    def total(self, weights: Sequence[float], matrices: Sequence[csr_array], pinned: Array) -> csr_array:
        """sum of weight * matrix, CSR (n,n); zeros of the pattern are stored."""
        data = np.zeros(self.pattern.nnz)
        for weight, matrix, way in zip(weights, matrices, self._ways, strict=True):
            _add(data, weight * matrix.data, way)
        if len(self._cleared):
            data[self._cleared] = 0.0
            data[self._diagonal] += pinned
        matrix = copy.copy(self.pattern)  # shares the indices; the constructor would check them every time
        matrix.data = data
        if self.symmetric is None:
            self.symmetric = bool(abs(matrix - matrix.T).max() <= 1e-10 * np.abs(data).max())
        return matrix


def _codes(matrix: csr_array) -> Any:
    """row * n + column of every stored entry."""
    n = matrix.shape[1]
    rows = np.repeat(np.arange(n), np.diff(matrix.indptr))
    return rows * n + matrix.indices


def _way(slots: Any, size: int) -> Any:
    """Where entries go: None when one to one, the places when none is shared, else the 0/1 matrix that adds them."""
    if len(slots) == size and (slots == np.arange(size)).all():
        return None
    if len(np.unique(slots)) == len(slots):
        return slots
    from scipy.sparse import csr_array

    return csr_array((np.ones(len(slots)), (slots, np.arange(len(slots)))), shape=(size, len(slots)))


def _add(data: Array, values: Array, way: Any) -> None:
    if way is None:
        data += values
    elif isinstance(way, np.ndarray):
        data[way] += values
    else:
        data += way @ values


def _kept(indices: Any) -> Any:
    """The array itself where nobody can change it, else a copy to compare with."""
    return indices if not indices.flags.writeable else indices.copy()


def _same(a: Any, b: Any) -> bool:
    return a is b or np.array_equal(a, b)
