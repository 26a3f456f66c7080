# loses: damping_forces
"""Assignment 02: springs and their force Jacobians.

Write the parts that raise NotImplementedError.  x and v are positions (m) and velocities (m/s) of N points in d
dimensions, arrays (N, d); pairs (E, 2) holds the two ends i, j of every spring; rest (E,) m, k (E,) N/m and c (E,)
kg/s belong to the springs.  No spring joins a point to itself; two points may be in the same place.
"""

import numpy as np


def energy(x, pairs, rest, k):
    """The sum of k/2 (|x_i - x_j| - rest)^2 over all springs, a number in joules."""
    # BEGIN SOLUTION: one length a spring
    edge = x[pairs[:, 0]] - x[pairs[:, 1]]
    return 0.5 * np.sum(k * (np.linalg.norm(edge, axis=1) - rest) ** 2)
    # END SOLUTION


def directions(x, pairs):
    """(lengths (E,), unit vectors (E, d)) of x_i - x_j; the unit vector of a spring without length is 0."""
    # BEGIN SOLUTION: mind the division
    edge = x[pairs[:, 0]] - x[pairs[:, 1]]
    length = np.linalg.norm(edge, axis=1)
    safe = np.where(length > 0, length, 1.0)
    return length, edge / safe[:, None]
    # END SOLUTION


def spring_forces(x, pairs, rest, k):
    """Forces (N, d) in newtons on all points, minus the gradient of the energy; 0 from a spring without length."""
    # BEGIN SOLUTION: several springs meet at a point: add
    length, n = directions(x, pairs)
    pull = -(k * (length - rest))[:, None] * n
    f = np.zeros(x.shape)
    np.add.at(f, pairs[:, 0], pull)
    np.add.at(f, pairs[:, 1], -pull)
    return f
    # END SOLUTION


def damping_forces(x, v, pairs, c):
    """Forces (N, d) that resist the rate of change of every length: -c (v_ij . n) n on i, the opposite on j."""
    # BEGIN SOLUTION: only the part of the velocity along the spring counts
    _, n = directions(x, pairs)
    rate = np.sum((v[pairs[:, 0]] - v[pairs[:, 1]]) * n, axis=1)
    push = -(c * rate)[:, None] * n
    f = np.zeros(x.shape)
    f[pairs[:, 0]] += push
    f[pairs[:, 1]] -= push
    return f
    # END SOLUTION


def stiffness_blocks(x, pairs, rest, k):
    """Blocks B (E, d, d): the derivative of the spring's force on i by x_i (all springs have length).

    B = -k [ n n^T + (1 - rest/length) (I - n n^T) ].
    """
    # BEGIN SOLUTION: along and across
    length, n = directions(x, pairs)
    along = n[:, :, None] * n[:, None, :]
    across = np.eye(x.shape[1]) - along
    return -k[:, None, None] * (along + (1 - rest / length)[:, None, None] * across)
    # END SOLUTION


def damping_blocks(x, pairs, c):
    """Blocks D (E, d, d): the derivative of the damper's force on i by v_i."""
    # BEGIN SOLUTION: what is linear in v is its own derivative
    _, n = directions(x, pairs)
    return -c[:, None, None] * n[:, :, None] * n[:, None, :]
    # END SOLUTION


def assemble(blocks, pairs, count):
    """The matrix (N d, N d), dense or sparse, of N = count points, from a block B (d, d) for each pair.

    B stands at (i, i) and (j, j), and -B at (i, j) and (j, i); where pairs share a point their blocks add.
    """
    # BEGIN SOLUTION: four places for each pair
    d = blocks.shape[1]
    matrix = np.zeros((count, d, count, d))
    for block, (i, j) in zip(blocks, pairs, strict=True):
        matrix[i, :, i, :] += block
        matrix[j, :, j, :] += block
        matrix[i, :, j, :] -= block
        matrix[j, :, i, :] -= block
    return matrix.reshape(count * d, count * d)
    # END SOLUTION


def force_by_parameters(x, pairs, rest, k):
    """(F_k, F_rest): derivatives of all spring forces, flattened to (N d,), by k and by rest, two arrays (N d, E)."""
    # BEGIN SOLUTION: the force is linear in both
    length, n = directions(x, pairs)
    by_k, by_rest = (np.zeros((*x.shape, len(pairs))) for _ in range(2))
    for e, (i, j) in enumerate(pairs):
        for point, sign in ((i, 1.0), (j, -1.0)):
            by_k[point, :, e] += -sign * (length[e] - rest[e]) * n[e]
            by_rest[point, :, e] += sign * k[e] * n[e]
    return by_k.reshape(x.size, -1), by_rest.reshape(x.size, -1)
    # END SOLUTION


def largest_stable_step(stiffness, masses):
    """The largest step (s) of symplectic Euler for M x'' = K x: 2/w, w^2 the largest eigenvalue of -M^-1 K.

    stiffness (n, n) is K, symmetric, dense or sparse; masses (n,) kg, one a coordinate.
    """
    # BEGIN SOLUTION: a symmetric form of the matrix keeps the eigenvalues real
    K = stiffness.toarray() if hasattr(stiffness, "toarray") else stiffness
    root = np.sqrt(masses)
    return 2 / np.sqrt(np.linalg.eigvalsh(-K / np.outer(root, root))[-1])
    # END SOLUTION
