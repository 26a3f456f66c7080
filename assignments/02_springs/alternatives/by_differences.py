"""Energy by its definition, forces from it by complex steps, derivatives by differences of order four."""

import numpy as np


def lengths(x, pairs):
    edge = x[pairs[:, 0]] - x[pairs[:, 1]]
    return np.sqrt((edge * edge).sum(axis=1))


def energy(x, pairs, rest, k):
    total = (k / 2 * (lengths(x, pairs) - rest) ** 2).sum()
    return total if np.iscomplexobj(total) else float(total)


def directions(x, pairs):
    length = lengths(x, pairs)
    n = np.zeros((len(pairs), x.shape[1]))
    np.divide(x[pairs[:, 0]] - x[pairs[:, 1]], length[:, None], out=n, where=length[:, None] > 0)
    return length, n


def spring_forces(x, pairs, rest, k):
    there = lengths(x, pairs) > 0
    pairs, rest, k = pairs[there], rest[there], k[there]
    f = np.zeros(x.size)
    for a in range(x.size):
        z = x.astype(complex).ravel()
        z[a] += 1e-100j
        f[a] = -energy(z.reshape(x.shape), pairs, rest, k).imag / 1e-100
    return f.reshape(x.shape)


def damping_forces(x, v, pairs, c):
    n = directions(x, pairs)[1]
    relative = v[pairs[:, 0]] - v[pairs[:, 1]]
    push = -np.einsum("e,ea,eb,eb->ea", c, n, n, relative)
    f = np.zeros(x.shape)
    for point in range(len(x)):
        f[point] = push[pairs[:, 0] == point].sum(axis=0) - push[pairs[:, 1] == point].sum(axis=0)
    return f


def slope(f, z, h):
    return (8 * (f(z + h) - f(z - h)) - (f(z + 2 * h) - f(z - 2 * h))) / 12


def stiffness_blocks(x, pairs, rest, k):
    d, blocks = x.shape[1], []
    for (i, j), r, ke in zip(pairs, rest, k):

        def force(xi, xj=x[j], r=r, ke=ke):
            length = np.linalg.norm(xi - xj)
            return -ke * (1 - r / length) * (xi - xj)

        blocks.append(np.stack([slope(force, x[i], 1e-3 * e) / 1e-3 for e in np.eye(d)], axis=1))
    return np.array(blocks)


def damping_blocks(x, pairs, c):
    zero, blocks = np.zeros((2, x.shape[1])), []
    for (i, j), ce in zip(pairs, c):
        ends, columns = x[[i, j]], []
        for e in np.eye(x.shape[1]):
            v = zero.copy()
            v[0] = e
            columns.append(damping_forces(ends, v, np.array([[0, 1]]), np.array([ce]))[0])
        blocks.append(np.stack(columns, axis=1))
    return np.array(blocks)


def assemble(blocks, pairs, count):
    signs = np.zeros((len(pairs), count))
    signs[np.arange(len(pairs)), pairs[:, 0]] = 1
    signs[np.arange(len(pairs)), pairs[:, 1]] = -1
    d = blocks.shape[1]
    return np.einsum("en,em,eab->namb", signs, signs, blocks).reshape(count * d, count * d)


def force_by_parameters(x, pairs, rest, k):
    eye = np.eye(len(pairs))
    by_k = [spring_forces(x, pairs, rest, e).ravel() for e in eye]
    by_rest = [spring_forces(x, pairs, rest + e, k).ravel() - spring_forces(x, pairs, rest, k).ravel() for e in eye]
    return np.stack(by_k, axis=1), np.stack(by_rest, axis=1)


def largest_stable_step(stiffness, masses):
    A = np.diag(masses**-0.5) @ -np.asarray(stiffness) @ np.diag(masses**-0.5)
    return 2 / np.sqrt(np.linalg.norm(A, 2))
