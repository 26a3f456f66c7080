"""Single particles with closed forms: a thrown ball, a planet, a leaf.  Lecture: "Particle system"."""

from __future__ import annotations

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Drag, Field, Gravity
from dsim.scenes.scene import Scene
from dsim.steppers import RK4, VelocityVerlet
from dsim.system import Flow, System


def projectile(
    speed: float = 12.0, angle: float = 0.9, mass: float = 0.2, drag: float = 0.1, h: float = 0.02, steps: int = 90
) -> Scene:
    """A ball thrown from the origin at `speed` m/s, `angle` rad above the horizontal, with drag -c v (c kg/s).

    With the time scale s = m/c and the terminal velocity u = s g,
    v(t) = u + (v0 - u) e^(-t/s)  and  x(t) = u t + (v0 - u) s (1 - e^(-t/s)).
    """
    g = np.array([0.0, -9.81])
    v0 = speed * np.array([np.cos(angle), np.sin(angle)])

    def exact(t: float) -> Array:
        if drag == 0:
            return np.concatenate([v0 * t + g * t**2 / 2, v0 + g * t])
        s = mass / drag
        fade = -np.expm1(-t / s)  # 1 - e^(-t/s) without cancellation at small t/s
        return np.concatenate([s * g * t + (v0 - s * g) * s * fade, v0 - (v0 - s * g) * fade])

    system = System([mass], [Gravity(g), Drag(drag)], dimension=2)
    summary = "A ball thrown in still air, with linear drag"
    return Scene("projectile", summary, system, [0, 0, *v0], h, steps, RK4(), exact)


def kepler(eccentricity: float = 0.6, h: float = 2 * np.pi / 1000, steps: int = 1000) -> Scene:
    """A planet around a fixed sun with GM = a = 1, from the pericentre; a period lasts 2 pi.

    f = -x/r^3, potential -1/r.  The truth follows from Kepler's equation t = E - e sin E:
    x = (cos E - e, b sin E) with b = sqrt(1 - e^2), and dE/dt = 1/(1 - e cos E).
    """
    e, b = eccentricity, np.sqrt(1 - eccentricity**2)

    def exact(t: float) -> Array:
        E = eccentric_anomaly(t, e)
        rate = 1 / (1 - e * np.cos(E))
        return np.array([np.cos(E) - e, b * np.sin(E), -np.sin(E) * rate, b * np.cos(E) * rate])

    system = System([1.0], [Field(_pull, _pull_jacobian, _pull_potential, name="sun")], dimension=2)
    invariants = {"energy": system.energy, "angular momentum": lambda t, y: float(y[0] * y[3] - y[1] * y[2])}
    summary = "A planet on an ellipse around a fixed sun, one period"
    y0, sun = exact(0.0), [[0.0, 0.0]]
    return Scene("kepler", summary, system, y0, h, steps, VelocityVerlet(), exact, invariants=invariants, marks=sun)


def eccentric_anomaly(mean: float, eccentricity: float) -> float:
    """E of Kepler's equation M = E - e sin E, to the round-off of M.

    Newton from pi converges for every M in [0, 2 pi) and e < 1, since the equation is convex on one side of pi
    and concave on the other.
    """
    turns = np.floor(mean / (2 * np.pi))
    M = mean - 2 * np.pi * turns
    E = np.pi
    for _ in range(50):
        correction = (E - eccentricity * np.sin(E) - M) / (1 - eccentricity * np.cos(E))
        E -= correction
        if abs(correction) <= 1e-15 * np.pi:
            break
    return float(E + 2 * np.pi * turns)


def _pull(x: Array) -> Array:
    r = np.linalg.norm(x, axis=1, keepdims=True)
    return -x / r**3


def _pull_jacobian(x: Array) -> Array:
    r = np.linalg.norm(x, axis=1)[:, None, None]
    return 3 * x[:, :, None] * x[:, None, :] / r**5 - np.eye(x.shape[1]) / r**3


def _pull_potential(x: Array) -> Array:
    return -1 / np.linalg.norm(x, axis=1)


def river(stream: float = 0.6, spin: float = 2.0, radius: float = 0.5, h: float = 0.05, steps: int = 200) -> Scene:
    """A leaf in an eddy that a river carries along: a first-order flow, dx/dt = phi(t, x).  Lecture: "ODEs".

    The eddy's centre drifts at u = (stream, 0) m/s and turns at w(t) = spin (1 + cos(t)/2) rad/s:
    phi = u + w(t) J (x - u t), J the quarter turn.  So x = u t + R(angle) x0, angle = spin (t + sin(t)/2).
    """
    u, quarter = np.array([stream, 0.0]), np.array([[0.0, -1.0], [1.0, 0.0]])

    def turning(t: float) -> float:
        return float(spin * (1 + np.cos(t) / 2))

    def exact(t: float) -> Array:
        angle = spin * (t + np.sin(t) / 2)
        return u * t + radius * np.array([np.cos(angle), np.sin(angle)])

    flow = Flow(lambda t, x: u + turning(t) * (quarter @ (x - u * t)), 2, lambda t, x: turning(t) * quarter)
    invariants = {"distance from the eddy": lambda t, y: float(np.linalg.norm(y - u * t))}
    summary = "A leaf in an eddy that a river carries along: a first-order flow"
    return Scene("river", summary, flow, exact(0.0), h, steps, RK4(), exact, invariants=invariants)
