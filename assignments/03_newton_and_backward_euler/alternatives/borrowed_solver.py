"""Steps are solved by scipy.optimize, and finished by a Newton of our own."""

import numpy as np
from scipy.linalg import solve
from scipy.optimize import root


def newton_step(equation, z):
    return z + solve(equation[1](z), -equation[0](z))


def newton(equation, z, tol=1e-10, most=50):
    for _ in range(most):
        try:
            with np.errstate(all="ignore"):
                new = newton_step(equation, z)
        except (np.linalg.LinAlgError, ValueError):
            return z, False
        if not np.isfinite(new).all():
            return z, False
        if np.max(np.abs(new - z)) <= tol:
            return new, True
        z = new
    return z, False


def line_search(equation, z, dz):
    lengths = 0.5 ** np.arange(31)
    before = np.linalg.norm(equation[0](z)) ** 2
    good = [a for a in lengths if np.linalg.norm(equation[0](z + a * dz)) ** 2 <= before * (1 - 2e-4 * a)]
    return good[0] if good else lengths[-1]


def careful_newton(equation, z, tol=1e-10, most=50):
    for _ in range(most):
        dz = newton_step(equation, z) - z
        if np.max(np.abs(dz)) <= tol:
            return z + dz, True
        z = z + line_search(equation, z, dz) * dz
    return z, False


def step_residual(motion, masses, q0, v0, h, v):
    return (v - v0) * masses - h * motion[0](q0 + v * h, v)


def step_matrix(motion, masses, q0, v0, h, v):
    return np.diag(masses) - h * motion[2](q0 + h * v, v) - h**2 * motion[1](q0 + h * v, v)


def backward_euler(motion, masses, q0, v0, h):
    found = root(
        lambda v: step_residual(motion, masses, q0, v0, h, v) / masses,
        v0,
        jac=lambda v: step_matrix(motion, masses, q0, v0, h, v) / masses[:, None],
        tol=1e-14,
    )
    v, _ = newton(
        (lambda v: step_residual(motion, masses, q0, v0, h, v), lambda v: step_matrix(motion, masses, q0, v0, h, v)),
        found.x,
    )
    return q0 + h * v, v


def simulate(motion, masses, q0, v0, h, steps):
    states = [(q0, v0)]
    while len(states) <= steps:
        states.append(backward_euler(motion, masses, *states[-1], h))
    return np.array([q for q, _ in states]), np.array([v for _, v in states])


def two_step(motion, masses, q_before, q0, h):
    q, _ = backward_euler(motion, masses, q0, (q0 - q_before) / h, h)
    return q
