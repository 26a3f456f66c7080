"""Time added up, sums in another order: round-off differs."""

import numpy as np


def forces(v, mass, gravity, drag, wind):
    f = drag * wind - drag * v
    f += mass.reshape(-1, 1) * gravity.reshape(1, -1)
    return f


def forward_euler(acceleration, x, v, t, h):
    dx, dv = h * v, h * acceleration(x, v, t)
    return dx + x, dv + v


def symplectic_euler(acceleration, x, v, t, h):
    dv = acceleration(x, v, t) * h
    return h * dv + (h * v + x), dv + v


def rk4(acceleration, x, v, t, h):
    half = t + 0.5 * h
    k1 = h * acceleration(x, v, t)
    k2 = h * acceleration(x + h * v / 2, v + k1 / 2, half)
    k3 = h * acceleration(x + h * v / 2 + h * k1 / 4, v + k2 / 2, half)
    k4 = h * acceleration(x + h * v + h * k2 / 2, v + k3, t + h)
    return x + h * v + h * (k1 + k2 + k3) / 6, v + (k1 + 2 * (k2 + k3) + k4) / 6


def simulate(method, acceleration, x0, v0, h, steps):
    step = {"forward_euler": forward_euler, "symplectic_euler": symplectic_euler, "rk4": rk4}[method]
    X, V = np.zeros((steps + 1,) + x0.shape), np.zeros((steps + 1,) + v0.shape)
    X[0], V[0], t = x0, v0, 0.0
    for n in range(steps):
        X[n + 1], V[n + 1] = step(acceleration, X[n].copy(), V[n].copy(), t, h)
        t += h
    return X, V


def largest_stable_step(stiffness, mass):
    return 2.0 * mass**0.5 * stiffness**-0.5
