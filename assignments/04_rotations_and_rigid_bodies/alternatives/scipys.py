"""With scipy's Rotation, whose quaternions have w at the end."""

import numpy as np
from scipy.spatial.transform import Rotation


def turn(q):
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


def quaternion(rotation):
    return np.roll(rotation.as_quat(), 1)


def product(p, q):
    """Complex matrices 2 x 2, which quaternions are."""

    def pauli(q):
        return np.array([[q[0] + 1j * q[3], q[2] + 1j * q[1]], [-q[2] + 1j * q[1], q[0] - 1j * q[3]]])

    both = pauli(q) @ pauli(p)
    return np.array([both[0, 0].real, both[0, 1].imag, both[0, 1].real, both[0, 0].imag])


def rotate(q, u):
    return turn(q).apply(u)


def rate_world(q, omega):
    return 0.5 * product(np.array([0.0, *omega]), q)


def rate_body(q, omega):
    """In the world's frame omega is turned."""
    return rate_world(q, rotate(q, omega))


def exponential(r):
    return quaternion(Rotation.from_rotvec(r))


def box_inertia(sides, mass):
    a, b, c = sides
    return mass * np.array([[b * b + c * c, 0, 0], [0, a * a + c * c, 0], [0, 0, a * a + b * b]]) / 12


def compose(masses, centres, inertias):
    mass, centre = masses.sum(), np.average(centres, axis=0, weights=masses)
    d = centres - centre
    squares = np.einsum("k,ki,ki->", masses, d, d)
    return mass, centre, inertias.sum(axis=0) + squares * np.eye(3) - (masses[:, None] * d).T @ d


def angular_acceleration(inertia, omega, torque):
    """Along the principal axes, where every moment has a line of its own."""
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    w, tau = axes.T @ omega, axes.T @ torque
    after, last = [1, 2, 0], [2, 0, 1]
    return axes @ ((tau + (moments[after] - moments[last]) * w[after] * w[last]) / moments)


def body_torque(q, x, point, force):
    return turn(q).inv().apply(np.cross(point - x, force))


def exponential_step(mass, inertia, state, points, forces, h):
    x, q, v, omega = state
    torque = turn(q).inv().apply(np.cross(points - x, forces).sum(axis=0))
    v = v + h * forces.sum(axis=0) / mass
    omega = omega + h * angular_acceleration(inertia, omega, torque)
    return x + h * v, quaternion(turn(q) * Rotation.from_rotvec(h * omega)), v, omega


def loop_step(mass, inertia, state, points, forces, h):
    """What is normalised turns by 2 atan(h |omega|/2), about the same axis."""
    x, _, v, omega = exponential_step(mass, inertia, state, points, forces, h)
    angle = h * np.linalg.norm(omega)
    short = Rotation.from_rotvec(2 * np.arctan(angle / 2) * omega / np.linalg.norm(omega))
    return x, quaternion(turn(state[1]) * short), v, omega


def free_body(inertia, q, omega, h, steps):
    """In the world's frame: the spin there is J^-1 L with J = R I R^T, and turns stand on the left."""
    start = turn(q)
    L = start.apply(inertia @ omega)

    def spin(R):
        return R.apply(np.linalg.solve(inertia, R.inv().apply(L)))

    turns = [start]
    for _ in range(steps):
        R = turns[-1]
        middle = Rotation.from_rotvec(h / 2 * spin(R)) * R
        turns.append(Rotation.from_rotvec(h * spin(middle)) * R)
    back = [np.linalg.solve(inertia, R.inv().apply(L)) for R in turns]
    return np.array([quaternion(R) for R in turns]), np.array(back)
