"""One spring after the other, in plain loops."""

import math

import numpy as np


def unit(x, i, j):
    edge = [float(a - b) for a, b in zip(x[i], x[j])]
    length = math.sqrt(sum(a * a for a in edge))
    return length, [a / length if length else 0.0 for a in edge]


def energy(x, pairs, rest, k):
    return sum(0.5 * ke * (unit(x, i, j)[0] - r) ** 2 for (i, j), r, ke in zip(pairs, rest, k))


def directions(x, pairs):
    found = [unit(x, i, j) for i, j in pairs]
    return np.array([length for length, _ in found]), np.array([n for _, n in found])


def spring_forces(x, pairs, rest, k):
    f = np.zeros(x.shape)
    for (i, j), r, ke in zip(pairs, rest, k):
        length, n = unit(x, i, j)
        for a in range(x.shape[1]):
            f[i, a] -= ke * (length - r) * n[a]
            f[j, a] += ke * (length - r) * n[a]
    return f


def damping_forces(x, v, pairs, c):
    f = np.zeros(x.shape)
    for (i, j), ce in zip(pairs, c):
        _, n = unit(x, i, j)
        rate = sum((v[i, a] - v[j, a]) * n[a] for a in range(x.shape[1]))
        for a in range(x.shape[1]):
            f[i, a] -= ce * rate * n[a]
            f[j, a] += ce * rate * n[a]
    return f


def stiffness_blocks(x, pairs, rest, k):
    d = x.shape[1]
    blocks = np.zeros((len(pairs), d, d))
    for e, (i, j) in enumerate(pairs):
        length, n = unit(x, i, j)
        for a in range(d):
            for b in range(d):
                across = (a == b) - n[a] * n[b]
                blocks[e, a, b] = -k[e] * (n[a] * n[b] + (1 - rest[e] / length) * across)
    return blocks


def damping_blocks(x, pairs, c):
    return np.array([[[-ce * a * b for b in n] for a in n] for ce, n in zip(c, directions(x, pairs)[1])])


def assemble(blocks, pairs, count):
    d = blocks.shape[1]
    matrix = np.zeros((count * d, count * d))
    for block, (i, j) in zip(blocks, pairs):
        for row, column, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            for a in range(d):
                for b in range(d):
                    matrix[row * d + a, column * d + b] += sign * block[a, b]
    return matrix


def force_by_parameters(x, pairs, rest, k):
    """Linear in k and rest: unit changes, one at a time."""
    by_k, by_rest = [], []
    zero = np.zeros(len(pairs))
    for e in range(len(pairs)):
        one = zero.copy()
        one[e] = 1.0
        by_k.append(spring_forces(x, pairs, rest, one).ravel())
        by_rest.append((spring_forces(x, pairs, rest + one, k) - spring_forces(x, pairs, rest, k)).ravel())
    return np.array(by_k).T, np.array(by_rest).T


def largest_stable_step(stiffness, masses):
    eigenvalues = np.linalg.eigvals(-stiffness / masses[:, None])
    return 2 / math.sqrt(max(value.real for value in eigenvalues))
