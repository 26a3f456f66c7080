"""A pendulum as a spring, stiff or soft.  Lecture: "Mass-spring systems" and "Explicit vs. implicit"."""

from __future__ import annotations

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Gravity, Springs
from dsim.scenes.scene import Scene, at_rest
from dsim.steppers import ImplicitMidpoint, VelocityVerlet
from dsim.system import System

EDGE = [(0, 1)]
GRAVITY = 9.81  # m/s^2


def pendulum_stiff(
    angle: float = 2.0, stiffness: float = 1e6, length: float = 1.0, h: float = 0.01, steps: int = 400
) -> Scene:
    """A bob of 1 kg on a spring so stiff (N/m) that it is nearly a rod, released at `angle` rad from the vertical.

    The spring's own vibration has h w = h sqrt(k/m) = 10: explicit methods need h w < 2.  The bob starts where the
    spring balances gravity's part along it, so that hardly any of that vibration is excited.
    """
    summary = "A pendulum on a spring as stiff as a rod: explicit methods blow up"
    stretched = length + GRAVITY * np.cos(angle) / stiffness
    system, y0 = _hung(length, stiffness), at_rest(_bob(angle, stretched))
    invariants = {"energy": system.energy}
    return Scene("pendulum_stiff", summary, system, y0, h, steps, ImplicitMidpoint(), edges=EDGE, invariants=invariants)


def pendulum_spring(
    angle: float = 2.0, stiffness: float = 60.0, length: float = 1.0, h: float = 0.01, steps: int = 400
) -> Scene:
    """A bob of 1 kg on a soft spring (N/m), released at `angle` rad from the vertical: it swings and bounces."""
    summary = "A pendulum on a soft spring: it swings and bounces"
    system, y0 = _hung(length, stiffness), at_rest(_bob(angle, length))
    invariants = {"energy": system.energy}
    return Scene("pendulum_spring", summary, system, y0, h, steps, VelocityVerlet(), edges=EDGE, invariants=invariants)


def _hung(length: float, stiffness: float) -> System:
    effects = [Gravity([0.0, -GRAVITY]), Springs(EDGE, length, stiffness)]
    return System([1.0, 1.0], effects, dimension=2, fixed=[0])


def _bob(angle: float, length: float) -> Array:
    """The hook at the origin and the bob at `angle` from the downward vertical, (2,2) m."""
    return np.array([[0.0, 0.0], [length * np.sin(angle), -length * np.cos(angle)]])


def rigid_pendulum_angle(t: float, angle: float = 2.0, length: float = 1.0, gravity: float = GRAVITY) -> float:
    """theta(t), rad, of a pendulum on a rigid rod, released at rest: what `pendulum_stiff` tends to.

    sin(theta/2) = k cd(w t | k^2) with k = sin(theta0/2), w = sqrt(g/l); cd = cn/dn is Jacobi's elliptic function
    (Whittaker, Analytical Dynamics, art. 44).

    >>> round(rigid_pendulum_angle(0.0), 12)
    2.0
    """
    from scipy.special import ellipj

    k = np.sin(angle / 2)
    _, cn, dn, _ = ellipj(np.sqrt(gravity / length) * t, k**2)
    return float(2 * np.arcsin(k * cn / dn))
