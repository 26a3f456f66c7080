"""SciPy does the linear algebra, and one Newton serves all."""

import warnings

import numpy as np
from scipy.linalg import lu_factor, lu_solve


def correction(equation, z):
    residual, jacobian = equation
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a singular matrix gives a correction that is not finite
        return -lu_solve(lu_factor(jacobian(z), check_finite=False), residual(z), check_finite=False)


def newton_step(equation, z):
    return z + correction(equation, z)


def solve(equation, z, tol, most, shorten):
    with np.errstate(all="ignore"):
        for _ in range(most):
            dz = correction(equation, z)
            if not np.all(np.isfinite(dz)):
                return z, False
            if np.linalg.norm(dz, np.inf) <= tol:
                return z + dz, True
            z = z + shorten(z, dz) * dz
    return z, False


def newton(equation, z, tol=1e-10, most=50):
    return solve(equation, z, tol, most, lambda z, dz: 1.0)


def line_search(equation, z, dz):
    r = equation[0]
    start = r(z) @ r(z)
    for halvings in range(31):
        a = 0.5**halvings
        with np.errstate(all="ignore"):
            there = r(z + a * dz)
        if there @ there <= start - 2e-4 * a * start:
            break
    return a


def careful_newton(equation, z, tol=1e-10, most=50):
    return solve(equation, z, tol, most, lambda z, dz: line_search(equation, z, dz))


def step_residual(motion, masses, q0, v0, h, v):
    return np.diag(masses) @ (v - v0) - motion[0](q0 + h * v, v) * h


def step_matrix(motion, masses, q0, v0, h, v):
    q = q0 + h * v
    return np.diag(masses) - h * (motion[2](q, v) + h * motion[1](q, v))


def backward_euler(motion, masses, q0, v0, h):
    equation = (
        (lambda v: step_residual(motion, masses, q0, v0, h, v)),
        (lambda v: step_matrix(motion, masses, q0, v0, h, v)),
    )
    v = careful_newton(equation, v0, tol=1e-12)[0]
    return q0 + h * v, v


def simulate(motion, masses, q0, v0, h, steps):
    out = np.empty((2, steps + 1, len(q0)))
    out[:, 0] = q0, v0
    for n in range(steps):
        out[:, n + 1] = backward_euler(motion, masses, *out[:, n], h)
    return out[0], out[1]


def two_step(motion, masses, q_before, q0, h):
    """Newton on the positions themselves."""
    force, by_q, by_v = motion
    q = 2 * q0 - q_before
    for _ in range(60):
        v = (q - q0) / h
        r = masses * (q - 2 * q0 + q_before) - h**2 * force(q, v)
        dq = -np.linalg.solve(np.diag(masses) - h**2 * by_q(q, v) - h * by_v(q, v), r)
        q = q + dq
        if np.abs(dq).max() < 1e-13:
            break
    return q
