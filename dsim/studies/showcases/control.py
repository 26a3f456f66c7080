"""Trajectory control: a soft trunk whose springs are its muscles writes a circle in the air.

Every spring above the base has a muscle beside it, and every muscle a rest length in every step: thousands of numbers,
turned by L-BFGS-B with the adjoint's gradient.  Lecture: "What about dynamics?", p = [f_0^act, ..., f_n^act].
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.gradients import Optimisation, ReducedObjective, Variables, optimise
from dsim.scenes.scene import Scene, at_rest
from dsim.simulation import Trajectory, simulate
from dsim.steppers import RK4, SymplecticEuler
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most
from dsim.studies.showcases.model import Fit, Report, Turned, slope_error, telling
from dsim.studies.showcases.muscles import Muscles
from dsim.system import System

SPACING = 0.1  # m, between the points of the trunk
SHORTEST, LONGEST = 0.75, 1.25  # rest lengths of muscles over those of the springs
EFFORT = 2e-5  # of the mean squared contraction, beside half the mean squared miss in decimetres

REACHED, TRUE_TO = 2e-3, 5e-3  # m: the tip's root mean square miss, in this program and in a finer one


@dataclass(frozen=True, eq=False)
class Trunk:
    """The body at rest, and what is asked of it.  scene: without contractions.  rest (E,) m: of the muscles.
    tip: the points at the top.  path (N+1,3) m: where their mean should be."""

    scene: Scene
    rest: Array
    tip: NDArray[np.int64]
    path: Array

    def tip_of(self, trajectory: Trajectory, every: int = 1) -> Array:
        """The tip's path (N+1,3) m, of every so many states."""
        x: Array = trajectory.q[::every].reshape(-1, self.scene.points, 3)[:, self.tip].mean(axis=1)
        return x

    def miss(self, trajectory: Trajectory, every: int = 1) -> float:
        """Root mean square distance of the tip from its path, m."""
        gap = self.tip_of(trajectory, every) - self.path
        return float(np.sqrt((gap**2).sum(axis=1).mean()))

    def objective(self, trajectory: Trajectory) -> tuple[float, Array, dict[str, Array]]:
        """Half the mean squared miss in decimetres, and a little for every contraction."""
        n, count = self.scene.system.n, len(self.path) * 0.1**2
        gap = self.tip_of(trajectory) - self.path
        dy = np.zeros(trajectory.y.shape)
        dy[:, :n].reshape(-1, self.scene.points, 3)[:, self.tip] = gap[:, None] / (len(self.tip) * count)
        system = trajectory.system
        assert isinstance(system, System)
        bent = system.split(system.theta)["muscles.rest_length"] / self.rest - 1
        value = 0.5 * float((gap**2).sum()) / count + EFFORT * float((bent**2).mean()) / (LONGEST - 1) ** 2
        return value, dy, {"muscles.rest_length": 2 * EFFORT / (LONGEST - 1) ** 2 / bent.size * bent / self.rest}

    @property
    def variables(self) -> Variables:
        return Variables(self.scene.system, self.scene.y0, ["muscles.rest_length"])

    def contracted(self) -> Turned:
        """u (steps E,) in -1 .. 1 -> the objective, rest lengths being rest (1 + 0.25 u)."""
        from scipy.sparse import diags_array

        scene, variables = self.scene, self.variables

        def run(system: System, y0: Array) -> Trajectory:
            return simulate(scene.stepper, system, y0, scene.h, scene.steps, keep="steps")

        fit = ReducedObjective(run, variables, self.objective)
        return Turned(fit, diags_array((LONGEST - 1) * variables.start), variables.start)


def trunk(floors: int, radius: float, stiffness: float, h: float, steps: int) -> Trunk:
    """A tower of `floors` cubes of 0.1 m, pinned at its base, whose tip shall run once round a circle (m) and return.

    stiffness N/m: of every spring, and of the muscle beside each that rises from floor to floor.
    """
    x = SPACING * np.array(list(itertools.product(range(2), range(2), range(floors + 1))), dtype=float)
    gap = np.linalg.norm(x[:, None] - x, axis=2)
    edges = np.stack(np.nonzero(np.triu((gap > 0) & (gap < 1.5 * SPACING))), axis=1)
    base = np.flatnonzero(x[:, 2] == 0)
    edges = edges[~np.isin(edges, base).all(axis=1)]
    rest = np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    rises = x[edges[:, 1], 2] != x[edges[:, 0], 2]
    muscles = Muscles(edges[rises], np.tile(rest[rises], (steps, 1)), stiffness, h)
    springs, damping = Springs(edges, rest, stiffness), SpringDamping(edges, 0.025 * np.sqrt(stiffness))
    effects = [Gravity([0.0, 0.0, -9.81]), springs, damping, muscles, Drag(0.01)]
    system = System(np.full(len(x), 0.05), effects, dimension=3, fixed=base)
    summary = f"{rises.sum()} muscles lead the tip of a soft trunk round a circle"
    scene = Scene("control", summary, system, at_rest(x), h, steps, SymplecticEuler(), edges=edges)
    tip = np.flatnonzero(np.isclose(x[:, 2], SPACING * floors))
    return Trunk(scene, rest[rises], tip, _circle(x[tip].mean(axis=0), radius, steps))


def _circle(start: Array, radius: float, steps: int) -> Array:
    """Once round, starting gently: start + r (1 - cos a, sin a, -(1 - cos a)/5), a = 2 pi s (1 - exp(-(s/0.15)^2))."""
    s = np.linspace(0, 1, steps + 1)
    angle = 2 * np.pi * s * -np.expm1(-((s / 0.15) ** 2))
    aside = 1 - np.cos(angle)
    return start + radius * np.stack([aside, np.sin(angle), -aside / 5], axis=1)


@dataclass(frozen=True, eq=False)
class Control:
    """What was found.  before, after: without and with contractions.  rest_length (steps,E) m.  slope: relative error
    of the gradient at the start, along one direction.  finer: the miss of RK4 at half the step, m."""

    trunk: Trunk
    before: Trajectory
    after: Trajectory
    rest_length: Array
    optimisation: Optimisation
    slope: float
    finer: float

    @property
    def missed(self) -> tuple[float, float]:
        """Root mean square miss before and after, m."""
        return self.trunk.miss(self.before), self.trunk.miss(self.after)

    def checks(self) -> tuple[Check, ...]:
        before, after = self.missed
        strained = float(np.abs(self.rest_length / self.trunk.rest - 1).max())
        gain = float(self.optimisation.values[0] / self.optimisation.value)
        return (
            at_least("control", "RMS miss at the start, m", before, 20 * REACHED),
            at_most("control", "gradient against a difference", self.slope, 1e-5),
            at_most("control", "RMS miss of the tip, m", after, REACHED),
            at_least("control", "start value / value", gain, 100.0),
            at_most("control", "the same by RK4 at h/2, m", self.finer, TRUE_TO),
            at_most("control", "largest contraction", strained, LONGEST - 1 + 1e-12),
        )


def run(quick: bool, report: Report | None = None) -> Control:
    """quick: 3 floors, 60 steps, 2160 numbers.  In full: 6 floors, 200 steps, 14,400 numbers."""
    task = trunk(3, 0.06, 100.0, 0.01, 60) if quick else trunk(6, 0.15, 400.0, 0.005, 200)
    return steered(task, 25 if quick else 70, report=report)


def steered(task: Trunk, iterations: int, fit: Fit | None = None, report: Report | None = None) -> Control:
    """Turn all rest lengths for so many iterations.  fit: another value and gradient, for tests."""
    turned = task.contracted()
    start = np.zeros(len(turned.offset))
    told = telling(report, iterations + iterations // 8, "objective")
    options = {"maxiter": iterations, "maxcor": 20}
    found = optimise(fit or turned, start, report=told, bounds=[(-1.0, 1.0)] * len(start), options=options)
    scene, rest_length = task.scene, turned.at(found.p)
    system, y0 = task.variables.place(rest_length)
    after = simulate(scene.stepper, system, y0, scene.h, scene.steps)
    finer = task.miss(simulate(RK4(), system, y0, scene.h / 2, 2 * scene.steps), every=2)
    slope = slope_error(fit or turned, start)
    return Control(task, scene.simulate(), after, rest_length.reshape(-1, len(task.rest)), found, slope, finer)
