"""The picture of success of assignment 06: a chain learns to hang in a circle."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsim.arrays.checks import Array
from dsim.effects import Gravity, Springs
from dsim.gradients.quasistatic import quasistatic
from dsim.pictures.style import COLOURS, DASHES, canvas, label, style
from dsim.system import System

LINKS, DAMPING, STEPS = 16, 1e-5, 4


def circle() -> Array:
    """Points of an arc of radius 1 m, hooks at the ends; slopes in equal steps, as equal weights make them."""
    angle = np.arctan(np.linspace(-0.8, 3.0, LINKS + 1))
    return np.stack([np.sin(angle), -np.cos(angle)], axis=1)


def design() -> tuple[list[Array], list[float]]:
    """Shapes (LINKS + 1, 2) and largest distances from the circle (m), before and after each Gauss-Newton step."""
    goal = circle()
    hooks = np.linspace(goal[0], goal[-1], LINKS + 1)
    drop = 0.1 * (1 - np.linspace(-1, 1, LINKS + 1) ** 2)
    apart = float(np.linalg.norm(goal[-1] - goal[0]))
    edges = np.stack([np.arange(LINKS), np.arange(1, LINKS + 1)], axis=1)
    effects = [Gravity([0.0, -9.81]), Springs(edges, apart / LINKS, 300.0)]
    system = System(np.full(LINKS + 1, 0.05), effects, dimension=2, fixed=[0, LINKS])
    q = (hooks - np.stack([0 * drop, drop], axis=1)).ravel()
    shapes, distances = [], []
    for _ in range(STEPS + 1):
        rest = quasistatic(system, q)
        q, slope = rest.q, rest.linearize().jacobian("springs.rest_length")
        shapes.append(q.reshape(-1, 2))
        distances.append(float(np.linalg.norm(shapes[-1] - goal, axis=1).max()))
        step = np.linalg.solve(slope.T @ slope + DAMPING * np.eye(LINKS), slope.T @ (goal.ravel() - q))
        lengths = system.split(system.theta)["springs.rest_length"] + step
        system = system.with_theta(system.join(**{**system.split(system.theta), "springs.rest_length": lengths}))
    return shapes, distances


@style()
def quasistatics() -> Figure:
    """The chain before, after one step and at the end; the distance from the circle after every step."""
    shapes, distances = design()
    figure, (left, right) = canvas(1, 2, size=(9.0, 4.2), width_ratios=[1.5, 1])
    left.plot(*circle().T, color="#b0b7bf", linewidth=7, label="target: an arc")
    for number, (shape, name) in enumerate(
        ((shapes[0], "links of equal length"), (shapes[1], "after one step"), (shapes[-1], f"after {STEPS} steps"))
    ):
        left.plot(*shape.T, color=COLOURS[number], linestyle=DASHES[number], marker="o", markersize=3.5, label=name)
    left.plot(*circle()[[0, -1]].T, "s", color="#1f2328", markersize=8)
    label(left, "x (m)", "y (m)", "A chain between two hooks")
    left.set_aspect("equal", "datalim")
    left.legend(loc="upper left", fontsize=9)
    right.semilogy(range(STEPS + 1), distances, marker="o", color=COLOURS[0])
    label(right, "steps of inverse design", "farthest point from the arc (m)", "Gauss-Newton")
    return figure
