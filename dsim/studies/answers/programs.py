"""Discrete programs: a few steps of a small scene with each method, to be compared to round-off.

Whoever uses the same formula must find the same numbers; no step size is small here, and none needs to be.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.arrays.differences import slope
from dsim.effects import Actuation, Drag, Gravity, SpringDamping, Springs
from dsim.gradients import Gradient, adjoint
from dsim.gradients.sensitivity import sensitivities
from dsim.scenes.nets import lattice
from dsim.simulation import Trajectory, simulate
from dsim.studies.answers.document import (
    Document,
    Item,
    certified,
    equations,
    evidence,
    header,
    objective,
    system_data,
    value_of,
)
from dsim.system import System

TOLERANCE = (1e-12, 1e-11)
NEWTON = 1e-13  # so that Newton's last correction is round-off

METHODS = {
    "ForwardEuler": ("y[n+1] = y[n] + h phi(t[n], y[n])",),
    "SymplecticEuler": ("v[n+1] = v[n] + h a(t[n], q[n], v[n])", "q[n+1] = q[n] + h v[n+1]"),
    "BackwardEuler": ("y[n+1] = y[n] + h phi(t[n+1], y[n+1])",),
    "TwoStepBackwardEuler": (
        "q[n+1] = 2 q[n] - q[n-1] + h^2 a(t[n+1], q[n+1], v[n+1])",
        "v[n+1] = (q[n+1] - q[n]) / h",
        "q[-1] = q[0] - h v[0]",
    ),
    "ImplicitMidpoint": ("y[n+1] = y[n] + h phi(t[n] + h/2, (y[n] + y[n+1]) / 2)",),
    "Trapezoidal": ("y[n+1] = y[n] + h/2 (phi(t[n], y[n]) + phi(t[n+1], y[n+1]))",),
    "BDF2": (
        "y[n+1] = 4/3 y[n] - 1/3 y[n-1] + 2/3 h phi(t[n+1], y[n+1])",
        "y[-1] = y[0] - h phi(t[0], y[0])",
    ),
    "VelocityVerlet": (
        "a0 = a(t[n], q[n], v[n])",
        "q[n+1] = q[n] + h v[n] + h^2/2 a0",
        "v[n+1] = v[n] + h/2 (a0 + a(t[n+1], q[n+1], v[n] + h a0))",
    ),
    "RK4": (
        "k1 = phi(t[n], y[n])",
        "k2 = phi(t[n] + h/2, y[n] + h/2 k1)",
        "k3 = phi(t[n] + h/2, y[n] + h/2 k2)",
        "k4 = phi(t[n] + h, y[n] + h k3)",
        "y[n+1] = y[n] + h/6 (k1 + 2 k2 + 2 k3 + k4)",
    ),
}
RATES = "phi(t, y) = (v, a(t, q, v)), a_i = f_i / m_i, and 0 for both at pinned points"
ROWS = "every evaluation inside step n uses forces[n] of the actuation; what is made up before step 0 uses forces[0]"


@dataclass(frozen=True, eq=False)
class Program:
    """`steps` steps of h (s) from y0.  J weighs every state: linear and quadratic (steps+1,ny)."""

    name: str
    description: str
    system: System
    y0: Array
    h: float
    steps: int

    @property
    def weights(self) -> tuple[Array, Array]:
        """Generic numbers; nothing at the velocities of pinned points."""
        shape = (self.steps + 1, self.system.size)
        seen = np.concatenate([np.ones(self.system.n), self.system.free])
        return generic(shape, 0.4) * seen, np.round(generic(shape, 2.1) ** 2, 4) * seen


def generic(shape: Any, phase: float, size: float = 1.0, around: float = 0.0) -> Array:
    """Short decimal numbers within `size` of `around`, no two neighbours alike, the same on every machine."""
    wave = np.cos(1.7 * np.arange(np.prod(shape, dtype=int)) + phase)
    return np.round(around + size * wave, 3).reshape(shape)


def ball() -> Program:
    """One point: the first thing to try."""
    effects = [Gravity([0.0, -9.81]), Drag(0.3, wind=[1.5, -0.25])]
    system = System([0.4], effects, dimension=2)
    return Program("ball", "A ball thrown into a steady wind, 8 steps", system, np.array([0.0, 1, 4, 5]), 0.05, 8)


def rope() -> Program:
    """Five points in a row, hung at the first."""
    points, steps, h = 5, 10, 0.02
    x = np.stack([0.25 * np.arange(points), generic(points, 0.9, 0.03)], axis=1)
    edges = np.stack([np.arange(points - 1), np.arange(1, points)], axis=1)
    effects = [
        Gravity([0.0, -9.81]),
        Springs(edges, generic(4, 0.2, 0.02, 0.24), generic(4, 1.0, 8.0, 60.0)),
        SpringDamping(edges, generic(4, 2.0, 0.05, 0.2)),
        Drag(0.04),
        Actuation(generic((steps, points, 2), 0.7, 0.5), h),
    ]
    system = System(generic(points, 0.3, 0.02, 0.1), effects, dimension=2, fixed=[0])
    v = generic((points, 2), 1.3, 0.4)
    v[0] = 0
    text = "A rope of 5 points hung at one end, pushed at every point, 10 steps"
    return Program("rope", text, system, np.concatenate([x.ravel(), v.ravel()]), h, steps)


def net() -> Program:
    """Nine points with everything that acts on points and springs."""
    steps, h = 6, 0.02
    flat, threads, diagonals = lattice((3, 3), 0.5)
    x = np.column_stack([flat, generic(9, 0.5, 0.05)])
    edges = np.concatenate([threads, diagonals])
    strength = np.repeat([40.0, 10.0], [len(threads), len(diagonals)])
    rest = np.round(np.linalg.norm(flat[edges[:, 1]] - flat[edges[:, 0]], axis=1), 3)
    effects = [
        Gravity([0.0, 0.0, -9.81]),
        Springs(edges, rest + generic(len(edges), 1.1, 0.03), strength + generic(len(edges), 0.6, 4.0)),
        SpringDamping(edges, generic(len(edges), 1.9, 0.03, 0.08)),
        Drag(generic(9, 0.8, 0.02, 0.06), wind=[0.8, -0.3, 0.5]),
        Actuation(generic((steps, 9, 3), 1.6, 0.3), h),
    ]
    system = System(generic(9, 0.1, 0.01, 0.05), effects, dimension=3, fixed=[0, 6])
    v = generic((9, 3), 2.4, 0.5)
    v[[0, 6]] = 0
    text = "A net of 3 x 3 points pinned at two corners, in wind, pushed at every point, 6 steps"
    return Program("net", text, system, np.concatenate([x.ravel(), v.ravel()]), h, steps)


SCENES: tuple[Callable[[], Program], ...] = (ball, rope, net)


def items(steppers: Sequence[Any]) -> list[Item]:
    """Every scene with every method."""
    return [item(program, stepper) for program in (build() for build in SCENES) for stepper in steppers]


def item(program: Program, stepper: Any) -> Item:
    """One scene with one method."""
    system = program.system
    return Item(
        f"{program.name}-{method_name(stepper)}",
        system.size,
        system.parameter_count,
        f"{program.steps} steps",
        TOLERANCE,
        "adjoint, sensitivity",
        lambda: document(program, stepper),
    )


def method_name(stepper: Any) -> str:
    """TwoStepBackwardEuler -> "two-step-backward-euler"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", type(stepper).__name__).lower()


def method_data(stepper: Any) -> Document:
    """The formula in words.  Raises ValueError for a method that nobody wrote down here."""
    formula = METHODS.get(type(stepper).__name__)
    if formula is None:
        raise ValueError(f"METHODS must state the formula of {type(stepper).__name__}, for readers without Python")
    return {"name": method_name(stepper), "formula": [*formula, RATES, ROWS]}


def document(program: Program, stepper: Any) -> Document:
    """The run, its gradient by everything, and what three routes say about it.

    The adjoint is held against forward sensitivities in every entry and against differences along one direction for
    each kind of parameter; the states against the equation of each step.
    """
    if stepper.implicit:
        stepper = replace(stepper, tol=NEWTON)
    system, (linear, quadratic) = program.system, program.weights
    trajectory = simulate(stepper, system, program.y0, program.h, program.steps)
    slopes = linear + quadratic * trajectory.y
    gradient = adjoint(trajectory, slopes)
    numbers = system_data(system)
    goal = objective(np.arange(program.steps + 1), linear, quadratic)
    found = header(f"{program.name}-{method_name(stepper)}", "program", program.description)
    found |= {
        "equations": equations(numbers),
        "system": numbers,
        "y0": program.y0,
        "time": {"h": program.h, "steps": program.steps},
        "method": method_data(stepper),
        "objective": goal,
        "answer": {
            "t": trajectory.t,
            "states": trajectory.y,
            "value": value_of(goal, trajectory.y),
            "gradient": {"y0": gradient.y0, **gradient.parts},
        },
        "scale": np.ones(system.size),
        "certificate": {
            "states": [evidence("largest residual of the method's equation in any step", _residual(trajectory))],
            "gradient": [
                evidence(
                    "discrete adjoint against forward sensitivity, every entry", _forward(trajectory, slopes, gradient)
                ),
                evidence("central differences, one direction a block", _differences(program, stepper, gradient)),
            ],
        },
        "tolerance": {"states": np.full(program.steps + 1, TOLERANCE[0]), "gradient": TOLERANCE[1]},
    }
    return certified(found)


def _residual(trajectory: Trajectory) -> float:
    stepper, system = trajectory.attached()
    steps = (trajectory.step(n) for n in range(len(trajectory.t) - 1))
    return max(float(np.abs(stepper.residual(system, step)).max()) for step in steps)


def _forward(trajectory: Trajectory, slopes: Array, gradient: Gradient) -> float:
    """The largest difference in any block, relative to the block's largest entry."""
    _, system = trajectory.attached()
    ny, P = system.size, system.parameter_count
    columns = sensitivities(trajectory, np.eye(ny, ny + P), np.eye(P, ny + P, ny))
    by_all = sum(slope @ change for slope, change in zip(slopes, columns, strict=True))
    pairs = [(by_all[:ny], gradient.y0)]
    pairs += [(a, gradient[name]) for name, a in system.split(by_all[ny:]).items()]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def _differences(program: Program, stepper: Any, gradient: Gradient) -> float:
    """How well differences of J confirm the adjoint, relative, along a direction for y0 and each kind of parameter."""
    system, (linear, quadratic) = program.system, program.weights
    places = system.split(np.arange(float(system.parameter_count))).values()
    blocks = [np.arange(system.size), *(system.size + place.ravel().astype(np.int64) for place in places)]
    start, whole = np.concatenate([program.y0, system.theta]), np.concatenate([gradient.y0, gradient.theta])
    worst = 0.0
    for block in blocks:
        direction = np.zeros(len(start))
        direction[block] = generic(block.shape, 0.0, 1.0) * np.maximum(np.abs(start[block]), 0.1)

        def cost(s: float, direction: Array = direction) -> Array:
            y0, theta = np.split(start + s * direction, [system.size])
            y = simulate(stepper, system.with_theta(theta), y0, program.h, program.steps).y
            return np.array([(linear * y + quadratic * y**2 / 2).sum()])

        found, told = float(slope(cost, 1e-3)[0]), float(whole @ direction)
        worst = max(worst, abs(found - told) / float(np.linalg.norm(whole[block] * direction[block])))
    if worst > 1e-5:
        raise ArithmeticError(f"{program.name}: differences say that the gradient is off by {worst:.1e}")
    return worst
