# loses: backward_euler, order, two_step
"""Assignment 03: Newton's method and backward Euler.

Write the parts that raise NotImplementedError.  An equation is a pair (residual, jacobian) of functions of z (n,); a
motion is a triple (force, by_q, by_v) of functions of (q, v), see kit.py.  masses (n,) kg, one a coordinate.
"""

import numpy as np


def newton_step(equation, z):
    """One step of Newton's method from z: the next guess (n,)."""
    residual, jacobian = equation
    return z - np.linalg.solve(jacobian(z), residual(z))


def newton(equation, z, tol=1e-10, most=50):
    """(z, converged): full Newton steps until a correction is at most tol in its largest entry, or `most` of them.

    converged is False where that did not happen, or where something is no longer finite; nothing is raised then.
    """
    with np.errstate(all="ignore"):
        for _ in range(most):
            try:
                new = newton_step(equation, z)
            except np.linalg.LinAlgError:
                return z, False
            if not np.isfinite(new).all():
                return z, False
            small = np.abs(new - z).max() <= tol
            z = new
            if small:
                return z, True
    return z, False


def line_search(equation, z, dz):
    """The first of 1, 1/2, 1/4, ... by which the step dz makes |residual|^2 fall enough, at least 2^-30.

    Enough (Armijo): |r(z + a dz)|^2 <= (1 - 2e-4 a) |r(z)|^2.  A value that is not finite is not enough.
    """
    residual, jacobian = equation
    before = np.sum(residual(z) ** 2)
    a = 1.0
    while a > 2.0**-30:
        with np.errstate(all="ignore"):
            after = np.sum(residual(z + a * dz) ** 2)
        if after <= (1 - 2e-4 * a) * before:
            return a
        a = a / 2
    return a


def careful_newton(equation, z, tol=1e-10, most=50):
    """(z, converged), as `newton`, with every step shortened by `line_search`."""
    for _ in range(most):
        dz = newton_step(equation, z) - z
        if np.abs(dz).max() <= tol:
            return z + dz, True
        z = z + line_search(equation, z, dz) * dz
    return z, False


def step_residual(motion, masses, q0, v0, h, v):
    """M (v - v0) - h f(q0 + h v, v): zero when v is the velocity after a step of backward Euler from (q0, v0)."""
    force, by_q, by_v = motion
    return masses * (v - v0) - h * force(q0 + h * v, v)


def step_matrix(motion, masses, q0, v0, h, v):
    """The derivative of `step_residual` by v, (n, n)."""
    force, by_q, by_v = motion
    q = q0 + h * v
    return np.diag(masses) - h * by_v(q, v) - h**2 * by_q(q, v)


def backward_euler(motion, masses, q0, v0, h):
    """(q1, v1) after one step of backward Euler, solved by Newton to a correction of 1e-10 from the guess v0."""

    def residual(v):
        return step_residual(motion, masses, q0, v0, h, v)

    def jacobian(v):
        return step_matrix(motion, masses, q0, v0, h, v)

    v, _ = newton((residual, jacobian), v0)
    return q0 + h * v0, v


def simulate(motion, masses, q0, v0, h, steps):
    """(Q, V): all states of `steps` steps of backward Euler, two arrays (steps + 1, n), the start in row 0."""
    q, v = [q0], [v0]
    for _ in range(steps):
        q1, v1 = backward_euler(motion, masses, q[-1], v[-1], h)
        q.append(q1)
        v.append(v1)
    return np.array(q), np.array(v)


def two_step(motion, masses, q_before, q0, h):
    """q1 (n,) of M (q1 - 2 q0 + q_before) = h^2 f(q1, (q1 - q0)/h): backward Euler without velocities."""
    return backward_euler(motion, masses, q0, (q0 - q_before) / h, h)[0]
