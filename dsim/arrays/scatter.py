"""From element values to global vectors and sparse matrices, by patterns that are built once.

An element touches k points of dimension d.  `S` sums element vectors (E,k,d) into (n,); `T` sums element
matrices (E,k,d,k,d) into the data of one fixed CSR pattern: assembly is a sparse matrix-vector product.
"""

from __future__ import annotations

import copy
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class ElementScatter:
    """Patterns of E elements with k points each, over `count` points in d dimensions.

    elements: (E,k) point indices.
    """

    def __init__(self, elements: NDArray[np.int64], count: int, dimension: int) -> None:
        self.elements = elements
        self.count = count
        self.dimension = dimension
        self.size = count * dimension
        dofs = elements[:, :, None] * dimension + np.arange(dimension)
        self.dofs = dofs.reshape(len(elements), elements.shape[1] * dimension)  # (E, k d)

    def gather(self, q: Array) -> Array:
        """(n,) -> (E,k,d): the points of every element."""
        points: Array = q.reshape(self.count, self.dimension)[self.elements]
        return points

    @cached_property
    def _sum(self) -> csr_array:  # the matrix S
        return _summation(self.dofs.ravel(), self.size)

    def vector(self, values: Array) -> Array:
        """(E,k,d) -> (n,): entries of shared points are added."""
        total: Array = self._sum @ values.ravel()
        return total

    @cached_property
    def _pattern(self) -> tuple[csr_array, csr_array]:
        from scipy.sparse import csr_array

        width = self.dofs.shape[1]
        rows = np.repeat(self.dofs, width, axis=1).ravel()
        columns = np.tile(self.dofs, (1, width)).ravel()
        places, slots = np.unique(rows * self.size + columns, return_inverse=True)
        counts = np.bincount(places // self.size, minlength=self.size)
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        indices = (places % self.size).astype(np.int32)
        empty = csr_array((np.zeros(len(places)), indices, indptr), shape=(self.size, self.size))
        return _shared(empty), _summation(slots, len(places))  # the pattern, the matrix T

    def matrix(self, values: Array) -> csr_array:
        """(E,k,d,k,d) -> CSR (n,n) with one pattern for the lifetime of this object."""
        pattern, summation = self._pattern
        return _with_data(pattern, summation @ values.ravel())

    # Elements of two points that only feel their edge x_j - x_i: one number each instead of four

    def edges(self, q: Array) -> Array:
        """(n,) -> (E,d): x_j - x_i."""
        points = q.reshape(self.count, self.dimension)
        edge: Array = points.take(self.elements[:, 1], 0) - points.take(self.elements[:, 0], 0)
        return edge

    @cached_property
    def _ends(self) -> csr_array:
        """(n, E d): -1 at i, +1 at j."""
        matrix = _summation(self.dofs.ravel(), self.size)  # columns (e, end, axis)
        ends, axes = np.divmod(matrix.indices % self.dofs.shape[1], self.dimension)
        matrix.data = 2.0 * ends - 1.0
        columns = matrix.indices // self.dofs.shape[1] * self.dimension + axes
        return _resized(matrix, columns, len(self.elements) * self.dimension)

    def edge_vector(self, values: Array) -> Array:
        """(E,d) -> (n,): minus at i, plus at j; `vector` of both ends."""
        total: Array = self._ends @ values.ravel()
        return total

    @cached_property
    def _edge_summation(self) -> csr_array:
        _, summation = self._pattern
        d, width = self.dimension, self.dofs.shape[1]
        element, place = np.divmod(summation.indices, width * width)
        (end, row), (other, column) = (np.divmod(axis, d) for axis in np.divmod(place, width))
        matrix = copy.copy(summation)
        matrix.data = np.where(end == other, 1.0, -1.0)
        return _resized(matrix, (element * d + row) * d + column, len(self.elements) * d * d)

    def edge_matrix(self, blocks: Array) -> csr_array:
        """(E,d,d) -> CSR (n,n), the blocks [[B,-B],[-B,B]]; `matrix` of both ends, in its pattern."""
        return _with_data(self._pattern[0], self._edge_summation @ blocks.ravel())

    def mixed(self, values: Array) -> csr_array:
        """(E,k,d,p) -> CSR (n, p E): parameter a of element e is column a E + e (fields lie one after another)."""
        from scipy.sparse import csr_array

        count, fields = len(self.elements), values.shape[-1]
        columns = np.arange(fields) * count + np.arange(count)[:, None, None]
        rows = np.broadcast_to(self.dofs[:, :, None], (count, self.dofs.shape[1], fields))
        columns = np.broadcast_to(columns, rows.shape)
        shape = (self.size, fields * count)
        return csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _shared(pattern: csr_array) -> csr_array:
    """The pattern with indices that nobody can change: many matrices share them."""
    for indices in (pattern.indices, pattern.indptr):
        indices.setflags(write=False)
    return pattern


def _with_data(pattern: csr_array, data: Array) -> csr_array:
    matrix = copy.copy(pattern)  # shares the indices; the constructor would check them every time
    matrix.data = data
    return matrix


def _resized(matrix: csr_array, columns: NDArray[np.int64], width: int) -> csr_array:
    """The matrix with its entries moved to other columns."""
    from scipy.sparse import csr_array

    return csr_array((matrix.data, columns.astype(np.int32), matrix.indptr), shape=(matrix.shape[0], width))


def _summation(slots: NDArray[np.int64], size: int) -> csr_array:
    """The 0/1 matrix (size, len(slots)) that adds entry i into place slots[i]."""
    from scipy.sparse import csr_array

    order = np.argsort(slots, kind="stable").astype(np.int32)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(slots, minlength=size))]).astype(np.int32)
    return csr_array((np.ones(len(slots)), order, indptr), shape=(size, len(slots)))


def diagonal(values: Array) -> csr_array:
    """(n,) -> CSR (n,n)."""
    return _with_data(_identity(len(values)), np.array(values, dtype=float))


@lru_cache(maxsize=16)
def _identity(n: int) -> csr_array:
    from scipy.sparse import csr_array

    indices, indptr = np.arange(n, dtype=np.int32), np.arange(n + 1, dtype=np.int32)
    return _shared(csr_array((np.ones(n), indices, indptr), shape=(n, n)))


def block_diagonal(blocks: Array) -> csr_array:
    """(N,d,d) -> CSR (N d, N d)."""
    from scipy.sparse import csr_array

    count, d = blocks.shape[:2]
    columns = np.repeat(np.arange(count * d).reshape(count, 1, d), d, axis=1)
    indptr = np.arange(0, count * d * d + 1, d)
    return csr_array((blocks.ravel(), columns.ravel(), indptr), shape=(count * d, count * d))


def few_columns(values: Array, columns: NDArray[np.int64], width: int) -> csr_array:
    """CSR (n,width) with the entries values (n,k) of every row at columns (n,k), increasing."""
    from scipy.sparse import csr_array

    rows, count = values.shape
    return csr_array((values.ravel(), columns.ravel(), count * np.arange(rows + 1)), shape=(rows, width))


def pointwise_jacobian(f: object, x: Array) -> Array:
    """Central differences of a callable x (N,d) -> (N,d) in which point i depends on x_i alone -> (N,d,d).

    All points are moved at once, so 2 d evaluations serve any N.  Truncation and round-off balance at a
    relative step eps^(1/3): expect nine to ten correct digits, not sixteen.
    """
    assert callable(f)
    step = np.cbrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(x))
    columns = []
    for axis in range(x.shape[1]):
        shift = np.zeros_like(x)
        shift[:, axis] = step[:, axis]
        ahead, behind = x + shift, x - shift
        columns.append((np.asarray(f(ahead)) - np.asarray(f(behind))) / (ahead - behind)[:, axis, None])
    return np.stack(columns, axis=2)
