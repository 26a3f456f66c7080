"""An incidence matrix does the gathering and the scattering; the matrix of the net is sparse."""

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import bsr_matrix, coo_matrix


def incidence(pairs, count):
    """(E, N): +1 at i, -1 at j."""
    rows = np.repeat(np.arange(len(pairs)), 2)
    return coo_matrix((np.tile([1.0, -1.0], len(pairs)), (rows, np.ravel(pairs))), (len(pairs), count)).tocsr()


def directions(x, pairs):
    edge = incidence(pairs, len(x)) @ x
    length = np.sqrt((edge**2).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return length, np.nan_to_num(edge / length[:, None])


def energy(x, pairs, rest, k):
    stretch = directions(x, pairs)[0] - rest
    return float(stretch @ (k * stretch)) / 2


def spring_forces(x, pairs, rest, k):
    length, n = directions(x, pairs)
    return -(incidence(pairs, len(x)).T @ ((k * (length - rest))[:, None] * n))


def damping_forces(x, v, pairs, c):
    A, (_, n) = incidence(pairs, len(x)), directions(x, pairs)
    return -(A.T @ ((c * ((A @ v) * n).sum(axis=1))[:, None] * n))


def stiffness_blocks(x, pairs, rest, k):
    """-k (1 - s) I - k s n n^T with s = rest/length: the same, sorted otherwise."""
    length, n = directions(x, pairs)
    s = rest / length
    return -np.einsum("e,ab->eab", k * (1 - s), np.eye(x.shape[1])) - np.einsum("e,ea,eb->eab", k * s, n, n)


def damping_blocks(x, pairs, c):
    return np.einsum("e,ea,eb->eab", -c, *[directions(x, pairs)[1]] * 2)


def assemble(blocks, pairs, count):
    i, j = np.transpose(pairs)
    d = blocks.shape[1]
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    data = np.concatenate([blocks, blocks, -blocks, -blocks])
    r = (rows[:, None, None] * d + np.arange(d)[:, None]).repeat(d, axis=2)
    c = (columns[:, None, None] * d + np.arange(d)[None, :]).repeat(d, axis=1)
    return bsr_matrix(coo_matrix((data.ravel(), (r.ravel(), c.ravel())), (count * d, count * d)).tocsr())


def force_by_parameters(x, pairs, rest, k):
    length, n = directions(x, pairs)
    A = incidence(pairs, len(x)).toarray()
    one = np.einsum("en,ed->nde", A, n).reshape(x.size, len(pairs))
    return -one * (length - rest), one * k


def largest_stable_step(stiffness, masses):
    dense = stiffness.toarray() if hasattr(stiffness, "toarray") else np.asarray(stiffness)
    return float(2 / np.sqrt(eigh(-dense, np.diag(masses), eigvals_only=True).max()))
