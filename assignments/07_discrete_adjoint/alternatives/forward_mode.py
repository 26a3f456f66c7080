"""Gradients by the sensitivity sweep: a row of dY/d(everything) at a time; SciPy finds the new velocity."""

import numpy as np
from scipy.optimize import root


def symplectic_step(body, y, u, p, h):
    n = len(u)
    new = y.copy()
    for i, f in enumerate(body.force(y[:n], y[n:], p)):
        new[n + i] += h * (f + u[i]) / body.mass[i]
        new[i] += h * new[n + i]
    return new


def symplectic_linearization(body, y, y1, p, h):
    n = len(y) // 2
    K, D, F = (f(y[:n], y[n:], p) for f in (body.dfdx, body.dfdv, body.dfdp))
    A, B, C = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, n)), np.zeros((2 * n, len(p)))
    for i in range(n):
        share = h / body.mass[i]
        A[n + i, :n], A[n + i, n:] = share * K[i], share * D[i]
        A[n + i, n + i] += 1
        B[n + i, i] = share
        C[n + i] = share * F[i]
        for matrix in (A, B, C):
            matrix[i] = h * matrix[n + i]
        A[i, i] += 1
    return A, B, C


def backward_step(body, y, u, p, h):
    x, v = y[: len(u)], y[len(u) :]

    def wrong(w):
        return body.mass * (w - v) - h * (body.force(x + h * w, w, p) + u)

    def slope(w):
        place = (x + h * w, w, p)
        return np.diag(body.mass) - h * body.dfdv(*place) - h * h * body.dfdx(*place)

    w = root(wrong, v, jac=slope, tol=1e-12).x
    w = w - np.linalg.solve(slope(w), wrong(w))
    return np.hstack([x + h * w, w])


def backward_linearization(body, y, y1, p, h):
    n = len(y) // 2
    place = (y1[:n], y1[n:], p)
    one, mass = np.eye(n), np.diag(body.mass)
    left = np.block([[one, -h * one], [-h * body.dfdx(*place), mass - h * body.dfdv(*place)]])
    right = np.zeros((2 * n, 3 * n + len(p)))
    right[:n, :n], right[n:, n : 2 * n], right[n:, 2 * n : 3 * n] = one, mass, h * one
    right[n:, 3 * n :] = h * body.dfdp(*place)
    found = np.linalg.solve(left, right)
    return found[:, : 2 * n], found[:, 2 * n : 3 * n], found[:, 3 * n :]


STEPS = {
    "symplectic": (symplectic_step, symplectic_linearization),
    "backward": (backward_step, backward_linearization),
}


def tangent(A, B, C, dy0, du, dp):
    rows = [dy0]
    for k in range(len(du)):
        rows += [A[k].dot(rows[k]) + B[k].dot(du[k]) + C[k].dot(dp)]
    return np.stack(rows)


def everything(triples, dldy, dldu, count):
    """The derivative of every state by (y0, all controls, p), met with the derivative of its cost."""
    (steps, n), size = dldu.shape, dldy.shape[1]
    slope = np.hstack([np.eye(size), np.zeros((size, steps * n + count))])
    total = dldy[0] @ slope
    for k, (A, B, C) in enumerate(triples):
        slope = A @ slope
        slope[:, size + k * n : size + (k + 1) * n] += B
        slope[:, size + steps * n :] += C
        total = total + dldy[k + 1] @ slope
    return total[:size], total[size : size + steps * n].reshape(steps, n) + dldu, total[size + steps * n :]


def adjoint(A, B, C, dldy, dldu):
    return everything(zip(A, B, C, strict=True), dldy, dldu, C.shape[2])


def gradient(method, problem, y0, u, p):
    (step, linearized), (body, cost, h) = STEPS[method], problem
    y, triples, dldy, dldu, value = y0, [], [], [], 0.0
    for k, control in enumerate(u):
        value += cost.state(k, y) + cost.control(k, control)
        dldy.append(cost.dldy(k, y))
        dldu.append(cost.dldu(k, control))
        new = step(body, y, control, p, h)
        triples.append(linearized(body, y, new, p, h))
        y = new
    value += cost.state(len(u), y)
    dldy.append(cost.dldy(len(u), y))
    return value, *everything(triples, np.array(dldy), np.array(dldu), len(p))


def checkpointed_gradient(method, problem, y0, u, p, every):
    """Sensitivities run forward with the states, so that nothing need be kept at all."""
    return gradient(method, problem, y0, u, p)
