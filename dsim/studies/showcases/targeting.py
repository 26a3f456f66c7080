"""Aiming: the velocity and spin with which a net is thrown through drag and gusts, so that it hits a frame flat.

Six numbers are turned by BFGS with the adjoint's gradient.  Lecture: "What about dynamics?", initial velocities as
parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.gradients import Optimisation, ReducedObjective, Variables, optimise
from dsim.scenes.nets import lattice
from dsim.scenes.scene import Scene, at_rest
from dsim.simulation import Trajectory, simulate
from dsim.steppers import RK4, VelocityVerlet
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most
from dsim.studies.showcases.model import Fit, Report, Turned, slope_error, telling
from dsim.system import System

G = 9.81  # m/s^2
HAND, BULLSEYE = np.array([0.0, 0.0, 1.5]), np.array([8.0, 1.0, 1.0])  # m: the net's centre at the start, and wanted
MASS, DRAG = 0.03, 0.02  # kg and kg/s of every point
SPIN = 3.0  # rad/s, the unit in which the spin is turned, so that it weighs as much as a metre a second
TOLERANCE, TRUE_TO = 5e-3, 5e-3  # m: the corners' root mean square miss, in this program and in a finer one


def gusts(t: float, x: Array) -> Array:
    """A head wind of 4 m/s and a cross wind of 2.5 m/s that turns with time; both fade towards the ground.  m/s."""
    fade = np.tanh(x[:, 2] / 2)
    return np.stack([-4 * fade, 2.5 * np.sin(2 * t) * fade, 0 * fade], axis=1)


def gusts_jacobian(t: float, x: Array) -> Array:
    """d gusts/dx (N,3,3), 1/s."""
    slope = np.zeros((len(x), 3, 3))
    slope[:, 0, 2] = -2 / np.cosh(x[:, 2] / 2) ** 2
    slope[:, 1, 2] = 1.25 * np.sin(2 * t) / np.cosh(x[:, 2] / 2) ** 2
    return slope


@dataclass(frozen=True, eq=False)
class Throw:
    """The net in the hand, and its marks: corners, and where they should be at the end, marks (4,3) m."""

    scene: Scene
    corners: NDArray[np.int64]
    marks: Array

    def gap(self, trajectory: Trajectory) -> Array:
        """How far the corners are off at the end, (4,3) m."""
        gap: Array = trajectory.last[: self.scene.system.n].reshape(-1, 3)[self.corners] - self.marks
        return gap

    def miss(self, trajectory: Trajectory) -> float:
        """Root mean square distance of the corners from their marks, m."""
        return float(np.sqrt((self.gap(trajectory) ** 2).sum(axis=1).mean()))

    def objective(self, trajectory: Trajectory) -> tuple[float, Array]:
        """Half the mean squared miss, m^2, and its derivative by the last state."""
        gap, dy = self.gap(trajectory), np.zeros(self.scene.system.size)
        dy[: self.scene.system.n].reshape(-1, 3)[self.corners] = gap / len(gap)
        return 0.5 * float((gap**2).sum(axis=1).mean()), dy

    def thrown(self) -> Turned:
        """z = (velocity m/s, spin / SPIN) (6,) -> the objective; point i leaves with v + w x (x_i - centre)."""
        scene = self.scene
        variables = Variables(scene.system, scene.y0, ["velocities"])
        arms = scene.y0[: scene.system.n].reshape(-1, 3) - HAND
        spins = [np.cross(axis, arms) for axis in SPIN * np.eye(3)]
        matrix = np.stack(
            [*(np.tile(axis, len(arms)) for axis in np.eye(3)), *(spin.ravel() for spin in spins)], axis=1
        )

        def run(system: System, y0: Array) -> Trajectory:
            return simulate(scene.stepper, system, y0, scene.h, scene.steps, keep="steps")

        return Turned(ReducedObjective(run, variables, self.objective), matrix, np.zeros(len(matrix)))

    def in_vacuum(self) -> Array:
        """The throw that would hit without air: a parabola, and a steady quarter turn."""
        T = self.scene.duration
        velocity = (BULLSEYE - HAND) / T + [0.0, 0.0, G * T / 2]
        return np.concatenate([velocity, [0.0, np.pi / 2 / T / SPIN, 0.0]])


def throw(n: int, wind: Any = gusts, wind_jacobian: Any = gusts_jacobian) -> Throw:
    """A net of n x n points, 1 m x 1 m, lying in the hand; after 1.2 s it should stand upright in its frame."""
    x, sides, diagonals = lattice((n, n), 1 / (n - 1))
    edges = np.concatenate([sides, diagonals])
    rest = np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    arms = np.column_stack([x - 0.5, np.zeros(n * n)])
    air = Drag(DRAG, wind, wind_jacobian)
    effects = [Gravity([0.0, 0.0, -G]), Springs(edges, rest, 30.0), SpringDamping(edges, 0.02), air]
    system = System(np.full(n * n, MASS), effects, dimension=3)
    corners = np.array([0, n - 1, n * n - 1, n * (n - 1)])
    marks = BULLSEYE + arms[corners] @ np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    summary = "A net thrown through drag and gusts hits a frame flat"
    scene = Scene("targeting", summary, system, at_rest(HAND + arms), 0.02, 60, VelocityVerlet(), edges=edges)
    return Throw(scene, corners, marks)


@dataclass(frozen=True, eq=False)
class Targeting:
    """What was found.  before: the throw for a vacuum; after: the one that hits.  velocity and spin (3,), m/s, rad/s.
    slope: relative error of the gradient at the start.  finer: the miss of RK4 at half the step, m."""

    throw: Throw
    before: Trajectory
    after: Trajectory
    velocity: Array
    spin: Array
    optimisation: Optimisation
    slope: float
    finer: float

    @property
    def missed(self) -> tuple[float, float]:
        """Root mean square miss before and after, m."""
        return self.throw.miss(self.before), self.throw.miss(self.after)

    def checks(self) -> tuple[Check, ...]:
        before, after = self.missed
        gain = float(self.optimisation.values[0] / self.optimisation.value)
        return (
            at_least("targeting", "RMS miss at the start, m", before, 100 * TOLERANCE),
            at_most("targeting", "gradient against a difference", self.slope, 1e-5),
            at_most("targeting", "RMS miss of the corners, m", after, TOLERANCE),
            at_least("targeting", "start value / value", gain, 1e4),
            at_most("targeting", "the same by RK4 at h/2, m", self.finer, TRUE_TO),
        )


def run(quick: bool, report: Report | None = None) -> Targeting:
    """quick: 4 x 4 points.  In full: 7 x 7."""
    return aimed(throw(4 if quick else 7), report=report)


def aimed(task: Throw, iterations: int = 40, fit: Fit | None = None, report: Report | None = None) -> Targeting:
    """Turn velocity and spin.  fit: another value and gradient, for tests."""
    turned, start = task.thrown(), task.in_vacuum()
    told, options = telling(report, 25, "objective"), {"maxiter": iterations, "gtol": 1e-5}
    found = optimise(fit or turned, start, method="BFGS", report=told, options=options)
    scene = task.scene

    def flown(z: Array, finer: int = 1) -> Trajectory:
        y0 = np.concatenate([scene.y0[: scene.system.n], turned.at(z)])
        stepper = scene.stepper if finer == 1 else RK4()
        return simulate(stepper, scene.system, y0, scene.h / finer, scene.steps * finer)

    velocity, spin = found.p[:3], SPIN * found.p[3:]
    slope, finer = slope_error(fit or turned, start), task.miss(flown(found.p, finer=2))
    return Targeting(task, flown(start), flown(found.p), velocity, spin, found, slope, finer)
