"""The position is the unknown of a step; the velocity follows.  Jacobians are inverted, which small ones bear."""

import numpy as np


def newton_step(equation, z):
    return z - np.linalg.inv(equation[1](z)) @ equation[0](z)


def newton(equation, z, tol=1e-10, most=50):
    count = 0
    np.seterr(all="ignore")
    while count < most and np.isfinite(z).all():
        try:
            new = newton_step(equation, z)
        except np.linalg.LinAlgError:
            break
        change, z, count = max(abs(new - z)), new, count + 1
        if change <= tol:
            return z, True
    return z, False


def line_search(equation, z, dz):
    size = lambda a: float(np.dot(*[equation[0](z + a * dz)] * 2))
    a, goal = 1, size(0)
    while not size(a) <= (1 - 2e-4 * a) * goal and a > 1e-9:
        a *= 0.5
    return float(a)


def careful_newton(equation, z, tol=1e-10, most=50):
    for _ in range(most):
        dz = newton_step(equation, z) - z
        if max(abs(dz)) <= tol:
            return z + dz, True
        z = z + line_search(equation, z, dz) * dz
    return z, False


def step_residual(motion, masses, q0, v0, h, v):
    return masses * v - masses * v0 - h * motion[0](q0 + h * v, v)


def step_matrix(motion, masses, q0, v0, h, v):
    matrix = -h * motion[2](q0 + h * v, v) - h * h * motion[1](q0 + h * v, v)
    matrix[np.diag_indices(len(v))] += masses
    return matrix


def backward_euler(motion, masses, q0, v0, h):
    def residual(q):
        return step_residual(motion, masses, q0, v0, h, (q - q0) / h)

    def jacobian(q):
        return step_matrix(motion, masses, q0, v0, h, (q - q0) / h) / h

    q, _ = newton((residual, jacobian), q0, tol=1e-13)
    return q, (q - q0) / h


def simulate(motion, masses, q0, v0, h, steps):
    Q, V = np.zeros((steps + 1, len(q0))), np.zeros((steps + 1, len(q0)))
    Q[0], V[0] = q0, v0
    for n in range(steps):
        Q[n + 1], V[n + 1] = backward_euler(motion, masses, Q[n], V[n], h)
    return Q, V


def two_step(motion, masses, q_before, q0, h):
    return backward_euler(motion, masses, q0, (q0 - q_before) / h, h)[0]
