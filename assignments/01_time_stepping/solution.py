"""Assignment 01: time stepping.

Write the parts that raise NotImplementedError.  x and v are positions (m) and velocities (m/s) of N points in d
dimensions, arrays (N, d); t is the time and h the step (s).  An acceleration is a function a(x, v, t) -> (N, d).
"""

import numpy as np


def forces(v, mass, gravity, drag, wind):
    """The total force (N, d) in newtons: gravity m g, and drag -c (v - wind).

    v (N, d), mass (N,) kg, gravity (d,) m/s^2, drag c kg/s, wind (d,) m/s.
    """
    # BEGIN SOLUTION: one line of NumPy; mass needs a second axis
    return mass[:, None] * gravity - drag * (v - wind)
    # END SOLUTION


def forward_euler(acceleration, x, v, t, h):
    """(x, v) after one step: both move with the old velocity and the old acceleration."""
    # BEGIN SOLUTION: two lines and a return
    a = acceleration(x, v, t)
    return x + h * v, v + h * a
    # END SOLUTION


def symplectic_euler(acceleration, x, v, t, h):
    """(x, v) after one step: the new velocity first, then the position with it."""
    # BEGIN SOLUTION: the order matters
    v = v + h * acceleration(x, v, t)
    return x + h * v, v
    # END SOLUTION


def rk4(acceleration, x, v, t, h):
    """(x, v) after one step of the classical Runge-Kutta method, for dx/dt = v, dv/dt = a(x, v, t)."""
    # BEGIN SOLUTION: four pairs (velocity, acceleration), weights 1, 2, 2, 1 over 6
    v1, a1 = v, acceleration(x, v, t)
    v2 = v + h / 2 * a1
    a2 = acceleration(x + h / 2 * v1, v2, t + h / 2)
    v3 = v + h / 2 * a2
    a3 = acceleration(x + h / 2 * v2, v3, t + h / 2)
    v4 = v + h * a3
    a4 = acceleration(x + h * v3, v4, t + h)
    return x + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    # END SOLUTION


METHODS = {"forward_euler": forward_euler, "symplectic_euler": symplectic_euler, "rk4": rk4}


def simulate(method, acceleration, x0, v0, h, steps):
    """(X, V), all states: arrays (steps + 1, N, d), the start in row 0, at t = 0.  method: a name in METHODS."""
    step = METHODS[method]
    # BEGIN SOLUTION: a loop over the steps; step n starts at t = n h
    x, v = np.empty((steps + 1, *x0.shape)), np.empty((steps + 1, *v0.shape))
    x[0], v[0] = x0, v0
    for n in range(steps):
        x[n + 1], v[n + 1] = step(acceleration, x[n], v[n], n * h, h)
    return x, v
    # END SOLUTION


def largest_stable_step(stiffness, mass):
    """The step (s) at which symplectic Euler stops being stable on a spring of stiffness k (N/m) and mass m (kg)."""
    # BEGIN SOLUTION: part 5 of the handout
    return 2 * np.sqrt(mass / stiffness)
    # END SOLUTION
