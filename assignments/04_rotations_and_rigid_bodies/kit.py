"""What is given: bodies to try things on.  Lengths in m, masses in kg, spins in rad/s in the frame of the body."""

import numpy as np


def racket():
    """(inertia (3,3), spin (3,)): spun about the axis of its middle moment, it turns over every 19.55 s."""
    return np.diag([1.0, 2.0, 3.0]), np.array([0.01, 1.0, 0.01])


def top():
    """(inertia (3,3), spin (3,)): a symmetric top.  Its spin circles its axis z at w_z (I_3 - I_1)/I_1 = 3.2 rad/s."""
    return np.diag([1.0, 1.0, 1.4]), np.array([0.5, 0.0, 8.0])


def hammer():
    """(sides (2,3), masses (2,), centres (2,3)): a handle along x, and a head across it at its end."""
    return np.array([[0.30, 0.03, 0.03], [0.04, 0.04, 0.12]]), np.array([0.2, 0.8]), np.array([[0, 0, 0], [0.17, 0, 0]])


def some_attitude(seed):
    """A unit quaternion (4,)."""
    q = np.random.default_rng(seed).normal(size=4)
    return q / np.linalg.norm(q)
