"""Soft bodies made of springs: a tower in gusts, and a robot that crawls.  Lecture: "What about dynamics?"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array
from dsim.arrays.scatter import diagonal
from dsim.effects import Actuation, Drag, Gravity, SpringDamping, Springs
from dsim.scenes.nets import lattice
from dsim.scenes.scene import Scene, at_rest
from dsim.steppers import BDF2, BackwardEuler
from dsim.system import System

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def soft_body(
    floors: int = 8,
    stiffness: float = 400.0,
    damping: float = 1.0,
    wind: float = 8.0,
    h: float = 0.02,
    steps: int = 300,
) -> Scene:
    """A soft tower of square floors of 0.25 m, two wide, in gusts that grow with height and travel with the wind.

    The air moves at wind * y/H * (1 + sin(3 x - 3 t))/2 along x; wind is the strongest gust at the top, m/s.
    stiffness N/m and damping kg/s of every spring.
    """
    x, sides, diagonals = lattice((3, floors + 1), 0.25)
    edges = np.concatenate([sides, diagonals])
    rest = np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    height = 0.25 * floors

    def air(t: float, x: Array) -> Array:
        gust = wind * x[:, 1] / height * (1 + np.sin(3 * x[:, 0] - 3 * t)) / 2
        return np.stack([gust, np.zeros(len(x))], axis=1)

    def air_jacobian(t: float, x: Array) -> Array:
        phase, slope = 3 * x[:, 0] - 3 * t, np.zeros((len(x), 2, 2))
        slope[:, 0, 0] = wind * x[:, 1] / height * 3 * np.cos(phase) / 2
        slope[:, 0, 1] = wind / height * (1 + np.sin(phase)) / 2
        return slope

    effects = [
        Gravity([0.0, -9.81]),
        Springs(edges, rest, stiffness),
        SpringDamping(edges, damping),
        Drag(0.03, air, air_jacobian),
    ]
    ground = np.flatnonzero(x[:, 1] == 0)
    system = System(np.full(len(x), 0.05), effects, dimension=2, fixed=ground)
    summary = "A soft tower of springs in gusts of wind that depend on place and time"
    return Scene("soft_body", summary, system, at_rest(x), h, steps, BDF2(), edges=edges)


def robot(
    thrust: float = 3.0, frequency: float = 1.0, stiffness: float = 40.0, h: float = 0.02, steps: int = 300
) -> Scene:
    """Three points of 0.2 kg on a floor, seen from above, joined by three springs with motors that push and pull.

    The motors' forces (thrust N at frequency Hz) act between the ends of a spring, one third of a period after
    another, so they cannot move the robot as a whole: what does is the floor, on which it slides more easily forward
    (along x) than backward.  The forces are one row a step, the parameters a controller would learn.
    """
    edges = np.array([(0, 1), (1, 2), (2, 0)])
    corners = 2 * np.pi * np.arange(3) / 3
    x = 0.5 / np.sqrt(3) * np.stack([np.cos(corners), np.sin(corners)], axis=1)  # sides of 0.5 m
    along = (x[edges[:, 1]] - x[edges[:, 0]]) / 0.5
    phase = 2 * np.pi * (frequency * h * np.arange(steps)[:, None] - np.arange(3) / 3)
    push = (thrust * np.sin(phase))[:, :, None] * along  # (steps, springs, 2)
    forces = np.zeros((steps, 3, 2))
    for spring, (i, j) in enumerate(edges):
        forces[:, i] -= push[:, spring]
        forces[:, j] += push[:, spring]
    effects = [Springs(edges, 0.5, stiffness), SpringDamping(edges, 0.4), Actuation(forces, h), _Bristles(2.0, 0.8)]
    system = System(np.full(3, 0.2), effects, dimension=2)
    summary = "Three springs with motors crawl over a floor that grips backward more than forward"
    return Scene("robot", summary, system, at_rest(x), h, steps, BackwardEuler(), edges=edges)


@dataclass(frozen=True, eq=False)
class _Bristles:
    """Resistance of a bristly floor, f = -c (v - a s(v_x) e_x), s(u) = sqrt(u^2 + w^2) - w: a smooth |u|.

    Nearly c (1 - a) against motion forward and c (1 + a) against motion backward, in kg/s; 0 <= a <= 1, so that it
    never feeds energy in.  Any class with a name and a force is an effect: this one shows how short it may be.
    """

    coefficient: float
    asymmetry: float
    width: float = 0.02  # m/s, the speed below which forward and backward are alike
    name: str = "floor"
    symmetric = True

    def force(self, t: float, q: Array, v: Array) -> Array:
        velocity = v.reshape(-1, 2)
        f = -self.coefficient * velocity
        f[:, 0] += self.coefficient * self.asymmetry * (np.hypot(velocity[:, 0], self.width) - self.width)
        return f.ravel()

    def dv(self, t: float, q: Array, v: Array) -> csr_array:
        velocity = v.reshape(-1, 2)
        slope = np.full(velocity.shape, -self.coefficient)
        slope[:, 0] += self.coefficient * self.asymmetry * velocity[:, 0] / np.hypot(velocity[:, 0], self.width)
        return diagonal(slope.ravel())
