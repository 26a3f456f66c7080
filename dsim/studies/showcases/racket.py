"""A racket thrown up so that it comes back face up: the spin, three numbers, with which it has to leave the hand.

About its middle axis a body does not turn for long: thrown with one plain turn the racket comes back upside down.  With
exactly no wobble it would not, on a knife's edge.  BFGS on the adjoint's gradient, from a guess with some twist, finds
the spin that brings it back as it left, with a whole twist on the way.  Lecture: "Rigid bodies", the gyroscopic term.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.effects import AngularDrag, Drag, Gravity
from dsim.effects.at_points import Attached
from dsim.gradients import Optimisation, ReducedObjective, Variables, optimise
from dsim.rigid import RigidBodies
from dsim.scenes.rigid import racket_properties
from dsim.simulation import Trajectory, simulate
from dsim.steppers import RK4, ImplicitMidpoint
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most
from dsim.studies.showcases.model import Fit, Report, Turned, slope_error, telling

G, FLIGHT = 9.81, 1.1  # m/s^2, s
FACE, HANDLE = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])  # in the body, and where they should point again
PLAIN = np.array([0.4, 2 * np.pi / FLIGHT, 0.0])  # rad/s: one turn about the middle axis, with a hand that shakes
GUESS = np.array([3.0, 2 * np.pi / FLIGHT, 0.0])  # the same with some twist
UNIT = 0.5  # rad/s, in which the spin is turned: BFGS begins with steps of the gradient's size
TOLERANCE = 0.5  # degrees


@dataclass(frozen=True, eq=False)
class Toss:
    """The racket in the hand.  spin -> how far its face and handle are from where they were, at the end."""

    system: RigidBodies
    y0: Array
    h: float
    steps: int
    stepper: Any = field(default_factory=RK4)

    def flown(self, spin: Array, finer: int = 1) -> Trajectory:
        y0 = np.concatenate([self.y0[:10], spin])
        stepper = self.stepper if finer == 1 else ImplicitMidpoint(tol=1e-12)
        return simulate(stepper, self.system, y0, self.h / finer, self.steps * finer)

    def objective(self, run: Trajectory) -> tuple[float, Array]:
        """J = 1/2 |R n - n|^2 + 1/2 |R a - a|^2 at the end, n the face's normal and a the handle; and dJ/dy.

        By a small turn delta in the body frame R n changes by R (delta x n), so dJ/d(delta) = n x R^T (R n - n) + ...
        """
        frame, y = self.system.frame, run.last
        q = y[: self.system.width]
        turn, value, bar = frame.turns(q), 0.0, np.zeros(self.system.n)
        for axis in (FACE, HANDLE):
            gap = rotation.rotate(turn, axis) - axis
            value += 0.5 * float((gap**2).sum())
            frame.spins(bar)[:] += np.cross(axis, rotation.rotate(rotation.conjugate(turn), gap))
        return value, np.concatenate([frame.small_turn_vjp(q, bar), np.zeros(self.system.n)])

    def by_spin(self) -> Turned:
        """z = spin / UNIT (3,) -> J and its gradient."""

        def run(system: Any, y0: Array) -> Trajectory:
            return simulate(self.stepper, system, y0, self.h, self.steps, keep="steps")

        variables = Variables(self.system, self.y0, {"velocities": [3, 4, 5]})
        return Turned(ReducedObjective(run, variables, self.objective), UNIT * np.eye(3), np.zeros(3))

    def angles(self, run: Trajectory) -> tuple[float, float]:
        """Degrees between face and handle at the end and where they should point."""
        turn = run.last[3:7][None]
        cosines = [float(rotation.rotate(turn, axis)[0] @ axis) for axis in (FACE, HANDLE)]
        face, handle = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        return float(face), float(handle)


def toss(steps: int) -> Toss:
    """Thrown up so that the hand catches it after FLIGHT seconds; air holds back the head and every turn."""
    racket = racket_properties()
    air = Attached(Drag(0.02), [0], [[0.15, 0.0, 0.0]])
    effects = [Gravity([0.0, 0.0, -G]), AngularDrag(2e-4), air]
    system = RigidBodies([racket.mass], racket.inertia[None], effects)
    y0 = system.state([0.0, 0.0, 1.2], None, [0.0, 0.0, G * FLIGHT / 2], PLAIN)
    return Toss(system, y0, FLIGHT / steps, steps)


@dataclass(frozen=True, eq=False)
class Racket:
    """What was found.  before: a plain turn; after: the spin (3,) rad/s that brings it back.  slope: relative error of
    the gradient at the start.  finer: degrees off by implicit midpoint at a tenth of the step."""

    toss: Toss
    before: Trajectory
    after: Trajectory
    spin: Array
    optimisation: Optimisation
    slope: float
    finer: float

    def checks(self) -> tuple[Check, ...]:
        gain = float(self.optimisation.values[0] / self.optimisation.value)
        return (
            at_least("racket", "the face off after a plain turn, degrees", self.toss.angles(self.before)[0], 90.0),
            at_most("racket", "gradient against a difference", self.slope, 1e-5),
            at_most("racket", "face and handle off, degrees", max(self.toss.angles(self.after)), TOLERANCE),
            at_most("racket", "the same by implicit midpoint at h/10, degrees", self.finer, TOLERANCE),
            at_least("racket", "start value / value", gain, 1e4),
        )


def run(quick: bool, report: Report | None = None) -> Racket:
    """quick: 16 steps.  In full: 50."""
    return caught(toss(16 if quick else 50), report=report)


def caught(task: Toss, iterations: int = 60, fit: Fit | None = None, report: Report | None = None) -> Racket:
    """Turn the spin.  fit: another value and gradient, for tests."""
    given, start = fit or task.by_spin(), GUESS / UNIT
    told, options = telling(report, 50, "objective"), {"maxiter": iterations, "gtol": 1e-7}
    found = optimise(given, start, method="BFGS", report=told, options=options)
    spin = UNIT * found.p
    slope, finer = slope_error(given, start), max(task.angles(task.flown(spin, finer=10)))
    return Racket(task, task.flown(PLAIN), task.flown(spin), spin, found, slope, finer)
