"""Loops over points and coordinates."""

import numpy as np


def forces(v, mass, gravity, drag, wind):
    f = np.zeros(v.shape)
    for i in range(v.shape[0]):
        for k in range(v.shape[1]):
            f[i, k] = mass[i] * gravity[k] - drag * v[i, k] + drag * wind[k]
    return f


def forward_euler(acceleration, x, v, t, h):
    a = acceleration(x, v, t)
    new_x, new_v = x.copy(), v.copy()
    for i in range(len(x)):
        new_x[i] += h * v[i]
        new_v[i] += h * a[i]
    return [new_x, new_v]


def symplectic_euler(acceleration, x, v, t, h):
    a = acceleration(x, v, t)
    new_x, new_v = x.copy(), v.copy()
    for i in range(len(x)):
        new_v[i] += h * a[i]
        new_x[i] += h * new_v[i]
    return new_x, new_v


def rk4(acceleration, x, v, t, h):
    def slope(x, v, t):
        return v, acceleration(x, v, t)

    total = [np.zeros(x.shape), np.zeros(v.shape)]
    k = [0 * x, 0 * v]
    for part, weight in ((0, 1), (0.5, 2), (0.5, 2), (1, 1)):
        k = slope(x + part * h * k[0], v + part * h * k[1], t + part * h)
        total = [total[0] + weight * k[0], total[1] + weight * k[1]]
    return x + h * total[0] / 6, v + h * total[1] / 6


def simulate(method, acceleration, x0, v0, h, steps):
    step = {"forward_euler": forward_euler, "symplectic_euler": symplectic_euler, "rk4": rk4}[method]
    xs, vs = [x0], [v0]
    for n in range(steps):
        x, v = step(acceleration, xs[-1], vs[-1], n * h, h)
        xs.append(x)
        vs.append(v)
    return np.array(xs), np.array(vs)


def largest_stable_step(stiffness, mass):
    return 2 / (stiffness / mass) ** 0.5
