"""Plain numbers and loops; numpy only at the door.  Quaternions that come out have w >= 0."""

import math

import numpy as np

EVEN = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def cross(a, b):
    return [a[j] * b[k] - a[k] * b[j] for _, j, k in EVEN]


def times(p, q):
    a, b, c, d = (float(i) for i in p)
    e, f, g, h = (float(i) for i in q)
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]


def product(p, q):
    return np.array(times(p, q))


def turn(q, u):
    """u + 2 w (a x u) + 2 a x (a x u)."""
    once = cross(q[1:], u)
    twice = cross(q[1:], once)
    return [float(u[i] + 2 * q[0] * once[i] + 2 * twice[i]) for i in range(3)]


def back(q, u):
    return turn([q[0], -q[1], -q[2], -q[3]], u)


def rotate(q, u):
    return np.array(turn(q, u))


def rate_body(q, omega):
    return np.array([c / 2 for c in times(q, [0.0, *omega])])


def rate_world(q, omega):
    return np.array([c / 2 for c in times([0.0, *omega], q)])


def turner(r):
    """A series where the angle is small, for there sin(a/2)/a would be 0/0."""
    angle = math.sqrt(sum(c * c for c in r))
    if angle < 1e-2:
        factor = 0.5 - angle**2 / 48 + angle**4 / 3840
    else:
        factor = math.sin(angle / 2) / angle
    return [math.cos(angle / 2)] + [float(factor * c) for c in r]


def exponential(r):
    q = turner(r)
    return np.array([-c for c in q] if q[0] < 0 else q)


def box_inertia(sides, mass):
    out = np.zeros((3, 3))
    for i, j, k in EVEN:
        out[i, i] = mass * (sides[j] ** 2 + sides[k] ** 2) / 12
    return out


def compose(masses, centres, inertias):
    """One part more at a time: two bodies have m1 m2/(m1 + m2) of their distance."""
    mass, centre, inertia = masses[0], list(centres[0]), inertias[0].tolist()
    for m, c, own in zip(masses[1:], centres[1:], inertias[1:]):
        d = [c[i] - centre[i] for i in range(3)]
        reduced = mass * m / (mass + m)
        for i in range(3):
            for j in range(3):
                inertia[i][j] += own[i][j] + reduced * ((i == j) * sum(a * a for a in d) - d[i] * d[j])
        centre = [(mass * centre[i] + m * c[i]) / (mass + m) for i in range(3)]
        mass += m
    return float(mass), np.array(centre), np.array(inertia)


def spun(inertia, omega):
    return [sum(float(inertia[i][j]) * float(omega[j]) for j in range(3)) for i in range(3)]


def solved(a, b):
    """Cramer's rule."""
    rows = [[float(c) for c in row] for row in a]
    det = sum(rows[0][i] * (rows[1][j] * rows[2][k] - rows[1][k] * rows[2][j]) for i, j, k in EVEN)
    columns = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])]
    return [sum(columns[n][i] * b[n] for n in range(3)) / det for i in range(3)]


def angular_acceleration(inertia, omega, torque):
    gyroscopic = cross(omega, spun(inertia, omega))
    return np.array(solved(inertia, [torque[i] - gyroscopic[i] for i in range(3)]))


def body_torque(q, x, point, force):
    return np.array(back(q, cross([point[i] - x[i] for i in range(3)], force)))


def moved(mass, inertia, state, points, forces, h):
    x, q, v, omega = state
    force, torque = [0.0] * 3, [0.0] * 3
    for point, f in zip(points, forces):
        tau = body_torque(q, x, point, f)
        for i in range(3):
            force[i] += f[i]
            torque[i] += tau[i]
    alpha = angular_acceleration(inertia, omega, torque)
    v = [v[i] + h * force[i] / mass for i in range(3)]
    omega = [omega[i] + h * alpha[i] for i in range(3)]
    return [x[i] + h * v[i] for i in range(3)], v, omega


def loop_step(mass, inertia, state, points, forces, h):
    x, v, omega = moved(mass, inertia, state, points, forces, h)
    q, rate = state[1], times(state[1], [0.0, *omega])
    q = [q[i] + h * rate[i] / 2 for i in range(4)]
    norm = math.hypot(*q)
    return np.array(x), np.array([c / norm for c in q]), np.array(v), np.array(omega)


def exponential_step(mass, inertia, state, points, forces, h):
    x, v, omega = moved(mass, inertia, state, points, forces, h)
    q = times(state[1], turner([h * c for c in omega]))
    return np.array(x), np.array([-c for c in q] if q[0] < 0 else q), np.array(v), np.array(omega)


def free_body(inertia, q, omega, h, steps):
    """Heun's rule: the turn is by the mean of the spins before and after."""
    q = [float(c) for c in q]
    momentum = turn(q, spun(inertia, omega))

    def spin(q):
        return solved(inertia, back(q, momentum))

    Q, W = [q], [[float(c) for c in omega]]
    for _ in range(steps):
        guess = times(Q[-1], turner([h * c for c in W[-1]]))
        mean = [(a + b) / 2 for a, b in zip(W[-1], spin(guess))]
        Q.append(times(Q[-1], turner([h * c for c in mean])))
        W.append(spin(Q[-1]))
    return np.array(Q), np.array(W)
