"""What is given: bodies that move, and costs.

A body has n coordinates with masses `mass` (n,) in kg.  The state is y = [x, v] (2n,), positions (m) and velocities
(m/s).  `force(x, v, p)` (n,) in N depends on parameters p (P,); `dfdx`, `dfdv` (n, n) and `dfdp` (n, P) are its
derivatives.  What you steer with, u (n,) in N, is added to that force.
A cost is a sum over the states y_0 ... y_N and the controls u_0 ... u_(N-1): `state(k, y)` and `control(k, u)` are
numbers, `dldy(k, y)` (2n,) and `dldu(k, u)` (n,) their derivatives.
"""

import numpy as np


class Swimmer:
    """A point in the plane on a hardening spring, in water that turns it aside and holds it back.

    f = -k x - b |x|^2 x + s (-x2, x1) - c (1 + |v|^2) v, p = (k, b, s, c).  df/dx is not symmetric.
    """

    def __init__(self, mass):
        self.mass = np.array([mass, mass])

    def force(self, x, v, p):
        return -(p[0] + p[1] * (x @ x)) * x + p[2] * np.array([-x[1], x[0]]) - p[3] * (1 + v @ v) * v

    def dfdx(self, x, v, p):
        spring = (p[0] + p[1] * (x @ x)) * np.eye(2) + 2 * p[1] * np.outer(x, x)
        return p[2] * np.array([[0.0, -1.0], [1.0, 0.0]]) - spring

    def dfdv(self, x, v, p):
        return -p[3] * ((1 + v @ v) * np.eye(2) + 2 * np.outer(v, v))

    def dfdp(self, x, v, p):
        return np.stack([-x, -(x @ x) * x, np.array([-x[1], x[0]]), -(1 + v @ v) * v], axis=1)


class Pendulums:
    """Pendulums of unequal masses in a row, x their angles, each tied to the next; p = (weight, tie, friction)."""

    def __init__(self, count):
        self.mass = 1.0 + 0.5 * np.arange(count)
        self.tie = np.diag(np.r_[np.ones(count - 1), 0.0]) + np.diag(np.r_[0.0, np.ones(count - 1)])
        self.tie -= np.diag(np.ones(count - 1), 1) + np.diag(np.ones(count - 1), -1)

    def force(self, x, v, p):
        return -p[0] * np.sin(x) - p[1] * (self.tie @ x) - p[2] * (v + v**3)

    def dfdx(self, x, v, p):
        return -p[0] * np.diag(np.cos(x)) - p[1] * self.tie

    def dfdv(self, x, v, p):
        return -p[2] * np.diag(1 + 3 * v**2)

    def dfdp(self, x, v, p):
        return -np.stack([np.sin(x), self.tie @ x, v + v**3], axis=1)


class Tracking:
    """Stay near a path, cheaply: l_k(y) = (weight_k / 2) |y - path_k|^2 and (price / 2) |u|^2."""

    def __init__(self, path, weight, price):
        self.path, self.weight, self.price = path, weight, price

    def state(self, k, y):
        return 0.5 * self.weight[k] * np.sum((y - self.path[k]) ** 2)

    def dldy(self, k, y):
        return self.weight[k] * (y - self.path[k])

    def control(self, k, u):
        return 0.5 * self.price * np.sum(u**2)

    def dldu(self, k, u):
        return self.price * u


def swimmer(mass=1.5):
    """A point in turning water: n = 2, P = 4."""
    return Swimmer(mass)


def pendulums(count=3):
    """Pendulums in a row: n = count, P = 3."""
    return Pendulums(count)


def tracking(path, weight, price=0.0):
    """A cost: path (N + 1, 2n), weight (N + 1,), price a number."""
    return Tracking(path, weight, price)
