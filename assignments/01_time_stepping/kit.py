"""What is given: accelerations a(x, v, t).  x and v are arrays (N, d), t is a number; a has their shape."""

import numpy as np


def oscillator(frequency):
    """A spring: a = -w^2 x."""
    return lambda x, v, t: -(frequency**2) * x


def pendulum(ratio):
    """A pendulum in its angle x: a = -(g/l) sin x."""
    return lambda x, v, t: -ratio * np.sin(x)


def falling(gravity, drag):
    """A point of 1 kg that falls with drag c: a = g - c v, g downward along the last coordinate."""

    def acceleration(x, v, t):
        a = -drag * v
        a[:, -1] -= gravity
        return a

    return acceleration


def shaken(frequency, strength):
    """A spring whose support is shaken: a = -w^2 x + s cos(t)."""
    return lambda x, v, t: -(frequency**2) * x + strength * np.cos(t)


def planet():
    """A planet around a sun of GM = 1: a = -x / |x|^3."""
    return lambda x, v, t: -x / np.linalg.norm(x, axis=1, keepdims=True) ** 3
