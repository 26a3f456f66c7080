"""A free body by the classical Runge-Kutta method on (q, L), more than is asked for; and vectors split off scalars."""

import numpy as np


def split(q):
    return float(q[0]), np.asarray(q[1:], dtype=float)


def product(p, q):
    """The linear map q -> p (x) q, column by column."""
    w, a = split(p)
    columns = [np.append(w, a)]
    for e in np.eye(3):
        columns.append(np.append(-a @ e, w * e + np.cross(a, e)))
    return np.stack(columns, axis=1) @ q


def rotate(q, u):
    """Rodrigues' formula, about the axis of q by its angle; no turn has no axis."""
    w, a = split(q)
    sine = np.linalg.norm(a)
    if sine == 0:
        return np.array(u, dtype=float)
    n, angle = a / sine, 2 * np.arctan2(sine, w)
    return np.cos(angle) * u + np.sin(angle) * np.cross(n, u) + (1 - np.cos(angle)) * (n @ u) * n


def back(q, u):
    return rotate(np.append(-q[0], q[1:]), u)


def rate_body(q, omega):
    w, a = split(q)
    return np.append(-a @ omega, w * omega + np.cross(a, omega)) / 2


def rate_world(q, omega):
    w, a = split(q)
    return np.append(-a @ omega, w * omega - np.cross(a, omega)) / 2


def exponential(r):
    """By halving: a tenth power of two of the turn is so small that four terms do, and then squares."""
    s = r / 1024
    n2 = s @ s
    q = np.append(1 - n2 / 8 + n2**2 / 384, (0.5 - n2 / 48 + n2**2 / 3840) * s)
    for _ in range(10):
        w, a = split(q)
        q = np.append(1 - 2 * a @ a, 2 * w * a)
    return q / np.linalg.norm(q)


def box_inertia(sides, mass):
    return mass / 12 * (np.sum(sides**2) * np.eye(3) - np.diag(sides) ** 2)


def compose(masses, centres, inertias):
    """Every pair of parts adds m_i m_j/(2 M) of its distance: no centre of mass is needed."""
    mass = masses.sum()
    d = centres[:, None] - centres[None]
    weights = masses[:, None] * masses[None] / (2 * mass)
    outer = np.einsum("ij,ijk,ijl->kl", weights, d, d)
    return mass, masses @ centres / mass, inertias.sum(axis=0) + np.trace(outer) * np.eye(3) - outer


def angular_acceleration(inertia, omega, torque):
    momentum = inertia @ omega
    return np.linalg.lstsq(inertia, torque + np.cross(momentum, omega), rcond=None)[0]


def body_torque(q, x, point, force):
    return back(q, np.cross(point, force) - np.cross(x, force))


def pushed(mass, inertia, state, points, forces, h):
    x, q, v, omega = state
    total, torque = np.zeros(3), np.zeros(3)
    for p, f in zip(points, forces):
        total, torque = total + f, torque + body_torque(q, x, p, f)
    v = v + h * total / mass
    return x + h * v, v, omega + h * angular_acceleration(inertia, omega, torque)


def loop_step(mass, inertia, state, points, forces, h):
    """In the frame of the world; the result has the other sign, and is the same attitude."""
    x, v, omega = pushed(mass, inertia, state, points, forces, h)
    q = state[1] + h * rate_world(state[1], rotate(state[1], omega))
    return x, -q / np.linalg.norm(q), v, omega


def exponential_step(mass, inertia, state, points, forces, h):
    x, v, omega = pushed(mass, inertia, state, points, forces, h)
    q = state[1]
    return x, product(exponential(h * rotate(q, omega)), q), v, omega


def free_body(inertia, q, omega, h, steps):
    momentum = rotate(q, inertia @ omega)

    def spin(q):
        return np.linalg.solve(inertia, back(q / np.linalg.norm(q), momentum))

    def rate(q):
        return rate_body(q, spin(q))

    Q, W = [q], [omega]
    for _ in range(steps):
        q = Q[-1]
        k1 = rate(q)
        k2 = rate(q + h / 2 * k1)
        k3 = rate(q + h / 2 * k2)
        k4 = rate(q + h * k3)
        new = q + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        Q.append(new / np.linalg.norm(new))
        W.append(spin(Q[-1]))
    return np.array(Q), np.array(W)
