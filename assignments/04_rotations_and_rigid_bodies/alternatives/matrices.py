"""Everything by matrices 3 x 3 and 4 x 4; a quaternion is made only where one is asked for."""

import numpy as np
from scipy.linalg import expm


def skew(a):
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def left(p):
    """product(p, q) = left(p) q."""
    w, x, y, z = p
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def product(p, q):
    return left(p) @ q


def matrix(q):
    w, a = q[0], q[1:]
    return (w**2 - a @ a) * np.eye(3) + 2 * np.outer(a, a) + 2 * w * skew(a)


def quaternion(R):
    """The eigenvector of the largest eigenvalue of Bar-Itzhack's matrix; its sign is nobody's choice."""
    K = np.empty((4, 4))
    K[0, 0] = np.trace(R)
    K[0, 1:] = K[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return np.linalg.eigh(K)[1][:, -1]


def rotate(q, u):
    return matrix(q) @ u


def rate_body(q, omega):
    w, x, y, z = q
    return 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]]) @ omega


def rate_world(q, omega):
    w, x, y, z = q
    return 0.5 * np.array([[-x, -y, -z], [w, z, -y], [-z, w, x], [y, -x, w]]) @ omega


def exponential(r):
    """exp of the matrix by which omega acts on quaternions."""
    return expm(0.5 * left(np.append(0.0, r)))[:, 0]


def box_inertia(sides, mass):
    second = np.diag(sides**2) * mass / 12
    return np.trace(second) * np.eye(3) - second


def compose(masses, centres, inertias):
    """About the origin first, with d^2 1 - d d^T = [d]x^T [d]x, and then to the centre of mass."""
    mass = masses.sum()
    centre = np.average(centres, axis=0, weights=masses)
    about_origin = sum(i + m * skew(c).T @ skew(c) for m, c, i in zip(masses, centres, inertias))
    return mass, centre, about_origin - mass * skew(centre).T @ skew(centre)


def angular_acceleration(inertia, omega, torque):
    return np.linalg.inv(inertia) @ (torque + skew(inertia @ omega) @ omega)


def body_torque(q, x, point, force):
    """Arm and force turned into the body, each on its own."""
    R = matrix(q)
    return skew(R.T @ (point - x)) @ R.T @ force


def loop_step(mass, inertia, state, points, forces, h):
    x, q, v, omega = state
    R = matrix(q)
    torque = R.T @ np.cross(points - x, forces).sum(axis=0)
    v = v + h / mass * forces.sum(axis=0)
    omega = omega + h * angular_acceleration(inertia, omega, torque)
    q = q + h * rate_body(q, omega)
    return x + h * v, q / np.sqrt(q @ q), v, omega


def exponential_step(mass, inertia, state, points, forces, h):
    """R exp([h omega]x), by Rodrigues' formula."""
    x, _, v, omega = loop_step(mass, inertia, state, points, forces, h)
    angle, n = h * np.linalg.norm(omega), skew(omega / np.linalg.norm(omega))
    turn = np.eye(3) + np.sin(angle) * n + (1 - np.cos(angle)) * n @ n
    return x, quaternion(matrix(state[1]) @ turn), v, omega


def free_body(inertia, q, omega, h, steps):
    """The midpoint rule on R, its turn by Cayley's map instead of the exponential one: of order 2 as well."""
    R, inverse = matrix(q), np.linalg.inv(inertia)
    L = R @ inertia @ omega

    def turned(R, w):
        return R @ np.linalg.solve(np.eye(3) - 0.5 * skew(w), np.eye(3) + 0.5 * skew(w))

    Q, W = [q], [omega]
    for _ in range(steps):
        middle = turned(R, 0.5 * h * inverse @ R.T @ L)
        R = turned(R, h * inverse @ middle.T @ L)
        Q.append(quaternion(R))
        W.append(inverse @ R.T @ L)
    return np.array(Q), np.array(W)
