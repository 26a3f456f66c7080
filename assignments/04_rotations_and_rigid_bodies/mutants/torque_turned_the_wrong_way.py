# loses: body_torque
"""Assignment 04: rotations and rigid bodies.

Write the parts that raise NotImplementedError.  A quaternion is an array (4,): w, x, y, z.  A unit quaternion q turns
vectors of the body into vectors of the world.  omega (3,) rad/s and inertia (3,3) kg m^2, about the centre of mass, are
in the frame of the body where nothing else is said; positions, velocities and forces are in the frame of the world.
"""

import numpy as np


def product(p, q):
    """p (x) q of any two quaternions: what turns by q first, and then by p."""
    a, b, c, d = p
    w, x, y, z = q
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def rotate(q, u):
    """The vector u (3,) of the body, seen from the world; q is a unit quaternion."""
    conjugate = q * np.array([1.0, -1.0, -1.0, -1.0])
    return product(product(q, np.append(0.0, u)), conjugate)[1:]


def rate_body(q, omega):
    """dq/dt (4,) of a body with the angular velocity omega, given in the frame of the body."""
    return 0.5 * product(q, np.append(0.0, omega))


def rate_world(q, omega):
    """dq/dt (4,) of a body with the angular velocity omega, given in the frame of the world."""
    return 0.5 * product(np.append(0.0, omega), q)


def exponential(r):
    """The unit quaternion (4,) that turns by the angle |r| rad about r (3,).  Any r, also 0, also above a full turn."""
    half = 0.5 * np.linalg.norm(r)
    return np.append(np.cos(half), 0.5 * np.sinc(half / np.pi) * r)


def box_inertia(sides, mass):
    """The inertia (3,3) kg m^2 of a solid box about its centre, along its edges.  sides (3,) m, whole edges."""
    squares = sides**2
    return mass / 12 * np.diag(squares.sum() - squares)


def compose(masses, centres, inertias):
    """(mass, centre (3,), inertia (3,3)) of K parts, rigidly joined.

    masses (K,), centres (K,3), inertias (K,3,3), each about the centre of its part; all in the same axes.  The result
    is about the common centre of mass.
    """
    mass = masses.sum()
    centre = masses @ centres / mass
    inertia = np.zeros((3, 3))
    for m, c, own in zip(masses, centres, inertias, strict=True):
        d = c - centre
        inertia += own + m * (d @ d * np.eye(3) - np.outer(d, d))
    return mass, centre, inertia


def angular_acceleration(inertia, omega, torque):
    """d(omega)/dt (3,) by Euler's equations; everything in the frame of the body.  inertia need not be diagonal."""
    return np.linalg.solve(inertia, torque - np.cross(omega, inertia @ omega))


def body_torque(q, x, point, force):
    """The torque (3,) about the centre of mass x (3,), in the frame of the body, of a force (3,) N at a point (3,) m.

    x, point and force are in the frame of the world.
    """
    conjugate = q * np.array([1.0, -1.0, -1.0, -1.0])
    return rotate(q, np.cross(point - x, force))


def loop_step(mass, inertia, state, points, forces, h):
    """The state (x, q, v, omega) after one step of the lecture's loop.

    forces (K,3) act at points (K,3), both in the frame of the world.  K may be 0.
    """
    x, q, v, omega = state
    torque = sum((body_torque(q, x, p, f) for p, f in zip(points, forces, strict=True)), np.zeros(3))
    v = v + h * forces.sum(axis=0) / mass
    omega = omega + h * angular_acceleration(inertia, omega, torque)
    q = q + h * rate_body(q, omega)
    return x + h * v, q / np.linalg.norm(q), v, omega


def exponential_step(mass, inertia, state, points, forces, h):
    """As `loop_step`, but q is turned by exactly h omega, so that its norm stays what it is."""
    x, q, v, omega = state
    x, _, v, omega = loop_step(mass, inertia, state, points, forces, h)
    return x, product(q, exponential(h * omega)), v, omega


def free_body(inertia, q, omega, h, steps):
    """(Q (steps+1,4), W (steps+1,3)): attitude and spin of a body without forces, the start in row 0.

    Order 2; the angular momentum in the frame of the world does not change at all.
    """
    momentum = rotate(q, inertia @ omega)
    back = np.array([1.0, -1.0, -1.0, -1.0])

    def spin(q):
        return np.linalg.solve(inertia, rotate(q * back, momentum))

    Q, W = [q], [omega]
    for _ in range(steps):
        middle = product(Q[-1], exponential(h / 2 * W[-1]))
        Q.append(product(Q[-1], exponential(h * spin(middle))))
        W.append(spin(Q[-1]))
    return np.array(Q), np.array(W)
