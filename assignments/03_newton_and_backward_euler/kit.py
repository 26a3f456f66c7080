"""What is given: problems to solve.

Equations: functions that return (residual, jacobian) of z.  Motions: functions that return (force, by_q, by_v) of
(q, v): the force (n,) N and its derivatives by q and by v, (n, n).
"""

import numpy as np


def root(power, target):
    """z_i^power = target_i."""
    target = np.asarray(target, dtype=float)

    def residual(z):
        return z**power - target

    def jacobian(z):
        return np.diag(power * z ** (power - 1))

    return residual, jacobian


def valley(scale, zero=0.0):
    """The slope of sum sqrt(1 + s^2 (z - zero)^2).  For zero = 0, Newton's full step is z -> -s^2 z^3."""

    def residual(z):
        return scale**2 * (z - zero) / np.sqrt(1 + (scale * (z - zero)) ** 2)

    def jacobian(z):
        return np.diag(scale**2 * (1 + (scale * (z - zero)) ** 2) ** -1.5)

    return residual, jacobian


def coupled(strength):
    """z_0 + s z_1^3 = 1, z_1 - s z_0^3 = 0: a Jacobian that is not symmetric."""

    def residual(z):
        return np.array([z[0] + strength * z[1] ** 3 - 1, z[1] - strength * z[0] ** 3])

    def jacobian(z):
        return np.array([[1.0, 3 * strength * z[1] ** 2], [-3 * strength * z[0] ** 2, 1.0]])

    return residual, jacobian


def spring(stiffness, damping):
    """f = -k q - c v for every coordinate."""

    def force(q, v):
        return -stiffness * q - damping * v

    def by_q(q, v):
        return -stiffness * np.eye(len(q))

    def by_v(q, v):
        return -damping * np.eye(len(q))

    return force, by_q, by_v


def pendulum(ratio, friction):
    """Pendulums in their angles, tied by weak springs: f_i = -r sin q_i - c v_i |v_i| + (q_(i-1) - q_i)."""

    def tie(n):
        return np.roll(np.eye(n), -1, axis=1) - np.eye(n) if n > 1 else np.zeros((n, n))

    def force(q, v):
        return -ratio * np.sin(q) - friction * v * np.abs(v) + tie(len(q)) @ q

    def by_q(q, v):
        return -ratio * np.diag(np.cos(q)) + tie(len(q))

    def by_v(q, v):
        return -2 * friction * np.diag(np.abs(v))

    return force, by_q, by_v
