"""One linearization formula for both methods through dv1; checkpoints by recursion: halves of the time."""

import numpy as np


def unpack(y):
    return y.reshape(2, -1)


def symplectic_step(body, y, u, p, h):
    x, v = unpack(y)
    new = v + np.diag(h / body.mass) @ (body.force(x, v, p) + u)
    return np.r_[x + h * new, new]


def backward_step(body, y, u, p, h):
    x, v = unpack(y)
    new = x.copy()  # the new position is the unknown
    for _ in range(12):
        w = (new - x) / h
        wrong = body.mass * (w - v) / h - body.force(new, w, p) - u
        slope = np.diag(body.mass) / h**2 - body.dfdx(new, w, p) - body.dfdv(new, w, p) / h
        new = new - np.linalg.solve(slope, wrong)
    w = (new - x) / h
    w = v + h * (body.force(new, w, p) + u) / body.mass
    return np.r_[x + h * w, w]


def triple(rows, h):
    """Rows of dv1 by (x, v), u, p -> the linearization, with x1 = x + h v1."""
    n = len(rows[0])
    below = [np.concatenate([h * row, row]) for row in rows]
    below[0][:n, :n] += np.identity(n)
    return tuple(below)


def symplectic_linearization(body, y, y1, p, h):
    (x, v), scale = unpack(y), np.diag(h / body.mass)
    here = (x, v, p)
    by_state = np.c_[scale @ body.dfdx(*here), np.identity(len(x)) + scale @ body.dfdv(*here)]
    return triple((by_state, scale, scale @ body.dfdp(*here)), h)


def backward_linearization(body, y, y1, p, h):
    x, v = unpack(y1)
    K, D, F = body.dfdx(x, v, p), body.dfdv(x, v, p), body.dfdp(x, v, p)
    mass = np.diag(body.mass)
    return triple(np.split(np.linalg.solve(mass - h * D - h * h * K, np.c_[h * K, mass, h * np.eye(len(x)), h * F]),
                           [2 * len(x), 3 * len(x)], axis=1), h)  # fmt: skip


def of(method):
    return globals()[method + "_step"], globals()[method + "_linearization"]


def tangent(A, B, C, dy0, du, dp):
    if len(A) == 0:
        return dy0[None]
    first = A[0] @ dy0 + B[0] @ du[0] + C[0] @ dp
    return np.concatenate([dy0[None], tangent(A[1:], B[1:], C[1:], first, du[1:], dp)])


def adjoint(A, B, C, dldy, dldu):
    """lam[k] = dJ/dy_k for all k first, then everything else at once."""
    lam = np.array(dldy, dtype=float)
    for k in range(len(A) - 1, -1, -1):
        lam[k] += lam[k + 1] @ A[k]
    return lam[0], np.einsum("kij,ki->kj", B, lam[1:]) + dldu, np.tensordot(C, lam[1:], axes=((0, 1), (0, 1)))


def back(method, problem, y, u, p, seam):
    """(mu -> mu, dJ/du, dJ/dp) of the steps u from y, by halves; seam: the first step, mu at the end."""
    (step, linearized), (body, cost, h), (first, last) = of(method), problem, seam
    if len(u) == 1:
        A, B, C = linearized(body, y, step(body, y, u[0], p, h), p, h)
        return cost.dldy(first, y) + A.T @ last, [cost.dldu(first, u[0]) + B.T @ last], C.T @ last
    half, middle = len(u) // 2, y
    for control in u[:half]:
        middle = step(body, middle, control, p, h)
    mu, late, by_late = back(method, problem, middle, u[half:], p, (first + half, last))
    mu, early, by_early = back(method, problem, y, u[:half], p, (first, mu))
    return mu, early + late, by_early + by_late


def checkpointed_gradient(method, problem, y0, u, p, every):
    body, cost, h = problem
    y, value = y0, 0.0
    for k in range(len(u)):
        value += cost.control(k, u[k]) + cost.state(k, y)
        y = of(method)[0](body, y, u[k], p, h)
    mu, by_control, by_parameter = back(method, problem, y0, u, p, (0, cost.dldy(len(u), y)))
    return value + cost.state(len(u), y), mu, np.array(by_control), by_parameter


def gradient(method, problem, y0, u, p):
    return checkpointed_gradient(method, problem, y0, u, p, 1)
