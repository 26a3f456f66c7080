"""Backward Euler of the benchmark's stiff cloth with CHOLMOD: Newton on the sparse matrix M + h c I + h^2 K.

The pattern is analysed once; a Newton iteration writes new values into it and factorizes.  CHOLMOD comes with cvxopt.
An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import numpy as np
from cvxopt import cholmod, matrix, spmatrix
from scipy.sparse import csr_array


class Pattern:
    """The lower triangle of the free coordinates' matrix, and the sums that fill it from spring blocks (E,3,3)."""

    def __init__(self, pairs, free):
        i, j = pairs.T
        number = np.where(free > 0, np.cumsum(free > 0) - 1, -1)
        blocks = np.arange(9 * len(pairs)).reshape(-1, 3, 3)
        rows, columns, sources, signs = [], [], [], []
        for a, b, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            row = np.broadcast_to(3 * number[a][:, None, None] + np.arange(3)[:, None], blocks.shape)
            column = np.broadcast_to(3 * number[b][:, None, None] + np.arange(3), blocks.shape)
            kept = ((number[a] >= 0) & (number[b] >= 0))[:, None, None] & (row >= column)
            rows.append(row[kept])
            columns.append(column[kept])
            sources.append(blocks[kept])
            signs.append(np.full(kept.sum(), sign))
        n = 3 * int((free > 0).sum())
        order = n * np.concatenate(columns) + np.concatenate(rows)  # by columns, as cvxopt stores them
        places, place = np.unique(order, return_inverse=True)
        shape = (len(places), blocks.size)
        self.sums = csr_array((np.concatenate(signs), (place, np.concatenate(sources))), shape=shape)
        self.on_diagonal = np.flatnonzero(places // n == places % n)
        self.matrix = spmatrix(0.0, (places % n).tolist(), (places // n).tolist(), (n, n))
        self.symbolic = cholmod.symbolic(self.matrix)

    def solve(self, blocks, shift, b):
        """x with (assembled blocks + shift I) x = b."""
        values = self.sums @ blocks.ravel()
        values[self.on_diagonal] += shift
        self.matrix.V = matrix(values)
        cholmod.numeric(self.matrix, self.symbolic)
        x = matrix(b)
        cholmod.solve(self.symbolic, x)
        return np.asarray(x).ravel()


def make(problem, tol=1e-10, max_iterations=50):
    """forward: (stiffness, v0) -> final (q, v).  tol bounds the last correction of v, relative to the largest."""
    i, j = problem["pairs"].T
    rest, free = problem["rest"], problem["free"] > 0
    mass, gravity, drag, h = problem["mass"], problem["gravity"], problem["drag"], problem["h"]
    points = np.arange(len(rest))
    ends = (np.r_[np.ones_like(rest), -np.ones_like(rest)], (np.r_[i, j], np.r_[points, points]))
    gather = csr_array(ends, shape=(len(free), len(rest)))  # pulls of springs -> forces on points
    pattern = Pattern(problem["pairs"], free)

    def springs(q, stiffness):
        """Forces (N,3), and -df/d(edge) of every spring (E,3,3)."""
        edge = q[j] - q[i]
        length = np.sqrt(np.einsum("ed,ed->e", edge, edge))
        slack = rest / length
        pull = (stiffness * (1 - slack))[:, None] * edge
        blocks = (stiffness * slack / length**2)[:, None, None] * (edge[:, :, None] * edge[:, None, :])
        blocks[:, range(3), range(3)] += (stiffness * (1 - slack))[:, None]
        return gather @ pull, blocks

    def forward(stiffness, v0):
        q, v = problem["q0"].copy(), v0 * free[:, None]
        for _ in range(problem["steps"]):
            before = v
            for _ in range(max_iterations):
                f, blocks = springs(q + h * v, stiffness)
                r = mass * (v - before) - h * (f + mass * gravity - drag * v)
                dv = np.zeros_like(v)
                dv[free] = -pattern.solve(h**2 * blocks, mass + h * drag, r[free].ravel()).reshape(-1, 3)
                v = v + dv
                if np.abs(dv).max() <= tol * np.abs(v).max():
                    break
            else:
                raise ArithmeticError("Newton did not converge")
            q = q + h * v
        return q, v

    return forward
