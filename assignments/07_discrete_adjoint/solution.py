"""Assignment 07: the discrete adjoint.

Write the parts that raise NotImplementedError.  `body` and `cost` are objects of kit.py: read there what they have.
The state is y = [x, v] (2n,), u (n,) is the force you steer with in a step, p (P,) are parameters, h is the step (s).
A linearization is the triple (A, B, C) = (dy1/dy (2n, 2n), dy1/du (2n, n), dy1/dp (2n, P)) of one step from y to y1.
"""

import numpy as np


def symplectic_step(body, y, u, p, h):
    """y1 (2n,): v1 = v + h M^-1 (f(x, v; p) + u), then x1 = x + h v1."""
    x, v = np.split(y, 2)
    # BEGIN SOLUTION: body.mass is the diagonal of M
    v = v + h * (body.force(x, v, p) + u) / body.mass
    return np.concatenate([x + h * v, v])
    # END SOLUTION


def symplectic_linearization(body, y, y1, p, h):
    """(A, B, C) of the symplectic step from y to y1.  You are given both; take derivatives where they belong."""
    # BEGIN SOLUTION: find the rows of v1, which lie below; those of x1 are those of x plus h times those of v1
    x, v = np.split(y, 2)
    n = len(x)
    rate = h / body.mass[:, None]
    by_state = np.hstack([rate * body.dfdx(x, v, p), np.eye(n) + rate * body.dfdv(x, v, p)])
    by_control, by_parameter = rate * np.eye(n), rate * body.dfdp(x, v, p)
    A = np.vstack([np.eye(n, 2 * n) + h * by_state, by_state])
    return A, np.vstack([h * by_control, by_control]), np.vstack([h * by_parameter, by_parameter])
    # END SOLUTION


def backward_step(body, y, u, p, h):
    """y1 (2n,): v1 = v + h M^-1 (f(x1, v1; p) + u) and x1 = x + h v1, both to 1e-10, by Newton's method on v1."""
    x, v = np.split(y, 2)
    # BEGIN SOLUTION: r(v1) = v1 - v - h M^-1 (f(x + h v1, v1) + u); its derivative has h df/dv and h^2 df/dx
    new, rate = v, h / body.mass
    for _ in range(30):
        place = (x + h * new, new, p)
        residual = new - v - rate * (body.force(*place) + u)
        if np.abs(residual).max() < 1e-12:
            break
        slope = np.eye(len(x)) - rate[:, None] * (body.dfdv(*place) + h * body.dfdx(*place))
        new = new - np.linalg.solve(slope, residual)
    return np.concatenate([x + h * new, new])
    # END SOLUTION


def backward_linearization(body, y, y1, p, h):
    """(A, B, C) of the backward Euler step from y to y1.  You are given both; take derivatives where they belong."""
    # BEGIN SOLUTION: differentiate the two equations; one matrix S = (M - h df/dv - h^2 df/dx)^-1 serves all
    x, v = np.split(y1, 2)
    n = len(x)
    mass, K = np.diag(body.mass), body.dfdx(x, v, p)
    S = np.linalg.inv(mass - h * body.dfdv(x, v, p) - h**2 * K)
    by_state = np.hstack([h * S @ K, S @ mass])
    by_control, by_parameter = h * S, h * S @ body.dfdp(x, v, p)
    A = np.vstack([np.eye(n, 2 * n) + h * by_state, by_state])
    return A, np.vstack([h * by_control, by_control]), np.vstack([h * by_parameter, by_parameter])
    # END SOLUTION


STEPS = {"symplectic": symplectic_step, "backward": backward_step}
LINEARIZATIONS = {"symplectic": symplectic_linearization, "backward": backward_linearization}


def simulate(method, body, y0, u, p, h):
    """Y (N + 1, 2n), all states, y0 in row 0; u (N, n).  Given."""
    states = [y0]
    for control in u:
        states.append(STEPS[method](body, states[-1], control, p, h))
    return np.array(states)


def tangent(A, B, C, dy0, du, dp):
    """dY (N + 1, 2n): how the states change, to first order, with y0, u and p.

    A (N, 2n, 2n), B (N, 2n, n), C (N, 2n, P): row k linearizes step k, from y_k to y_(k+1).
    dy0 (2n,), du (N, n), dp (P,): the changes.
    """
    # BEGIN SOLUTION: forward, a step at a time
    change = np.empty((len(A) + 1, len(dy0)))
    change[0] = dy0
    for k in range(len(A)):
        change[k + 1] = A[k] @ change[k] + B[k] @ du[k] + C[k] @ dp
    return change
    # END SOLUTION


def adjoint(A, B, C, dldy, dldu):
    """(dJ/dy0 (2n,), dJ/du (N, n), dJ/dp (P,)) of J = sum_k l_k(y_k) + sum_k c_k(u_k), in one sweep backward.

    A, B, C as in `tangent`.  dldy (N + 1, 2n): the derivative of the cost of y_k in row k; dldu (N, n) likewise.
    """
    # BEGIN SOLUTION: mu is dJ/dy_(k+1) when step k is looked at; take from it what u_k and p get, then move on
    mu = dldy[-1].copy()
    by_control, by_parameter = dldu.copy(), np.zeros(C.shape[2])
    for k in reversed(range(len(A))):
        by_control[k] += B[k].T @ mu
        by_parameter += C[k].T @ mu
        mu = A[k].T @ mu + dldy[k]
    return mu, by_control, by_parameter
    # END SOLUTION


def gradient(method, problem, y0, u, p):
    """(J, dJ/dy0 (2n,), dJ/du (N, n), dJ/dp (P,)) of a whole trajectory.

    method: a name in STEPS.  problem: body, cost and h.
    """
    body, cost, h = problem
    # BEGIN SOLUTION: simulate, linearize every step, sum up the cost, sweep back
    y = simulate(method, body, y0, u, p, h)
    steps = range(len(u))
    value = sum(cost.state(k, y[k]) for k in range(len(y))) + sum(cost.control(k, u[k]) for k in steps)
    A, B, C = map(np.array, zip(*(LINEARIZATIONS[method](body, y[k], y[k + 1], p, h) for k in steps), strict=True))
    dldy = np.array([cost.dldy(k, y[k]) for k in range(len(y))])
    dldu = np.array([cost.dldu(k, u[k]) for k in steps])
    return value, *adjoint(A, B, C, dldy, dldu)
    # END SOLUTION


def checkpointed_gradient(method, problem, y0, u, p, every):
    """The same four as `gradient`, to 1e-12, from the states 0, every, 2 every, ... alone.

    The states between are computed again, one segment at a time, the last segment first; it may be a short one.
    """
    body, cost, h = problem
    # BEGIN SOLUTION: forward, keeping few states; then, segment by segment from the end, simulate again and sweep
    y, kept, value = y0, {}, 0.0
    for k in range(len(u)):
        if k % every == 0:
            kept[k] = y
        value += cost.state(k, y) + cost.control(k, u[k])
        y = STEPS[method](body, y, u[k], p, h)
    value += cost.state(len(u), y)
    mu = cost.dldy(len(u), y)
    by_control, by_parameter = np.empty(u.shape), np.zeros(len(p))
    for start in reversed(kept):
        part = u[start : start + every]
        y = simulate(method, body, kept[start], part, p, h)
        for k in reversed(range(len(part))):
            A, B, C = LINEARIZATIONS[method](body, y[k], y[k + 1], p, h)
            by_control[start + k] = cost.dldu(start + k, part[k]) + B.T @ mu
            by_parameter += C.T @ mu
            mu = A.T @ mu + cost.dldy(start + k, y[k])
    return value, mu, by_control, by_parameter
    # END SOLUTION
