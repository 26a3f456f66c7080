"""Both sweeps as one large triangular system; the steps from matrices of the whole state."""

import numpy as np
from scipy.linalg import block_diag, solve_triangular


def halves(y):
    return y[: len(y) // 2], y[len(y) // 2 :]


def symplectic_step(body, y, u, p, h):
    x, v = halves(y)
    total = body.force(x, v, p) + u
    return np.append(x + h * v + h * h * total / body.mass, v + h * total / body.mass)


def symplectic_linearization(body, y, y1, p, h):
    x, v = halves(y)
    n = len(x)
    kick, drift = np.eye(2 * n), np.eye(2 * n)
    kick[n:, :n] += np.diag(h / body.mass) @ body.dfdx(x, v, p)
    kick[n:, n:] += np.diag(h / body.mass) @ body.dfdv(x, v, p)
    drift[:n, n:] = h * np.eye(n)
    push = drift @ np.vstack([np.zeros((n, n)), np.diag(h / body.mass)])
    return [drift @ kick, push, push @ body.dfdp(x, v, p)]


def equations(body, y1, y, u, p, h):
    x, v = halves(y1)
    return y1 - y - h * np.append(v, (body.force(x, v, p) + u) / body.mass)


def slopes(body, y1, p, h):
    x, v = halves(y1)
    n, over = len(x), np.diag(1 / body.mass)
    flow = np.block([[np.zeros((n, n)), np.eye(n)], [over @ body.dfdx(x, v, p), over @ body.dfdv(x, v, p)]])
    return np.eye(2 * n) - h * flow


def backward_step(body, y, u, p, h):
    y1 = y
    for _ in range(10):
        y1 = y1 - np.linalg.solve(slopes(body, y1, p, h), equations(body, y1, y, u, p, h))
    return y1


def backward_linearization(body, y, y1, p, h):
    x, v = halves(y1)
    inverse = np.linalg.inv(slopes(body, y1, p, h))
    push = h * inverse[:, len(x) :] @ np.diag(1 / body.mass)
    return inverse, push, push @ body.dfdp(x, v, p)


def step(method, *rest):
    return {"symplectic": symplectic_step, "backward": backward_step}[method](*rest)


def linearized(method, *rest):
    return {"symplectic": symplectic_linearization, "backward": backward_linearization}[method](*rest)


def system(A):
    """Unit lower block bidiagonal: row k + 1 says dy_(k+1) - A_k dy_k = push."""
    steps, size, _ = A.shape
    matrix = np.eye((steps + 1) * size)
    matrix[size:, :-size] -= block_diag(*A)
    return matrix


def tangent(A, B, C, dy0, du, dp):
    pushes = np.concatenate([[dy0], [b @ w + c @ dp for b, c, w in zip(B, C, du, strict=True)]])
    return solve_triangular(system(A), pushes.ravel(), lower=True, unit_diagonal=True).reshape(len(A) + 1, -1)


def adjoint(A, B, C, dldy, dldu):
    lam = solve_triangular(system(A), dldy.ravel(), trans="T", lower=True, unit_diagonal=True).reshape(dldy.shape)
    by_control = [dldu[k] + lam[k + 1] @ B[k] for k in range(len(A))]
    return lam[0], np.array(by_control), sum(lam[k + 1] @ C[k] for k in range(len(A)))


def gradient(method, problem, y0, u, p):
    body, cost, h = problem
    states, triples, value = [y0], [], 0.0
    for k, control in enumerate(u):
        value += cost.state(k, states[-1]) + cost.control(k, control)
        states.append(step(method, body, states[-1], control, p, h))
        triples.append(linearized(method, body, states[-2], states[-1], p, h))
    value += cost.state(len(u), states[-1])
    dldy = np.array([cost.dldy(k, y) for k, y in enumerate(states)])
    dldu = np.array([cost.dldu(k, w) for k, w in enumerate(u)])
    A, B, C = (np.stack([triple[i] for triple in triples]) for i in range(3))
    return [value, *adjoint(A, B, C, dldy, dldu)]


def checkpointed_gradient(method, problem, y0, u, p, every):
    """From kept states, a state at a time: each is computed again from the last one that was kept."""
    body, cost, h = problem
    kept, y = [y0], y0
    for k, control in enumerate(u):
        nearest = kept[-1] if k % every == 0 else y
        y = step(method, body, nearest, control, p, h)
        if (k + 1) % every == 0:
            kept.append(y)

    def state(k):
        y = kept[k // every]
        for j in range(k // every * every, k):
            y = step(method, body, y, u[j], p, h)
        return y

    last = state(len(u))
    value, mu, by_control, by_parameter = cost.state(len(u), last), cost.dldy(len(u), last), [], np.zeros(len(p))
    for k in range(len(u) - 1, -1, -1):
        y = state(k)
        A, B, C = linearized(method, body, y, state(k + 1), p, h)
        value += cost.state(k, y) + cost.control(k, u[k])
        by_control.insert(0, cost.dldu(k, u[k]) + mu @ B)
        by_parameter = by_parameter + mu @ C
        mu = mu @ A + cost.dldy(k, y)
    return value, mu, np.array(by_control), by_parameter
