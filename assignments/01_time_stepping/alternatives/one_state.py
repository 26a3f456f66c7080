"""Position and velocity in one array."""

import numpy as np


def forces(v, mass, gravity, drag, wind):
    return np.outer(mass, gravity) + drag * (wind - v)


def rate(acceleration, z, t):
    return np.stack([z[1], acceleration(z[0], z[1], t)])


def forward_euler(acceleration, x, v, t, h):
    z = np.stack([x, v])
    return tuple(z + h * rate(acceleration, z, t))


def symplectic_euler(acceleration, x, v, t, h):
    a = acceleration(x, v, t)
    return x + h * v + h**2 * a, v + h * a


def rk4(acceleration, x, v, t, h):
    z = np.stack([x, v])
    k1 = rate(acceleration, z, t)
    k2 = rate(acceleration, z + 0.5 * h * k1, t + 0.5 * h)
    k3 = rate(acceleration, z + 0.5 * h * k2, t + 0.5 * h)
    k4 = rate(acceleration, z + h * k3, t + h)
    return tuple(z + h * (k1 / 6 + k2 / 3 + k3 / 3 + k4 / 6))


def simulate(method, acceleration, x0, v0, h, steps):
    states = np.zeros((2, steps + 1, *x0.shape))
    states[:, 0] = x0, v0
    t = 0.0
    for n in range(1, steps + 1):
        states[:, n] = globals()[method](acceleration, *states[:, n - 1], t, h)
        t = n * h
    return states[0], states[1]


def largest_stable_step(stiffness, mass):
    """Where the eigenvalue of the step's matrix leaves the circle: h^2 w^2 = 4."""
    return float(np.sqrt(4 * mass / stiffness))
