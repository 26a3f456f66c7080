"""The picture of success of assignment 07: a point on a spring is steered along a figure of eight."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Springs
from dsim.gradients.adjoint import adjoint
from dsim.gradients.objectives import Variables
from dsim.gradients.optimisation import Optimisation, optimise
from dsim.pictures.style import COLOURS, canvas, label, style
from dsim.simulation import simulate
from dsim.steppers import SymplecticEuler
from dsim.system import System

STEPS, H, PRICE = 40, 0.075, 1e-4


def eight() -> Array:
    """Where the point should be at every state, (STEPS + 1, 2) m: once around in 3 s."""
    angle = 2 * np.pi * np.linspace(0, 1, STEPS + 1)
    return np.stack([np.sin(angle), 0.5 * np.sin(2 * angle)], axis=1)


def steering() -> tuple[Optimisation, Array, Array, Array]:
    """What the optimiser found, the path without forces, the path with them, (STEPS + 1, 2) each, and the forces."""
    start = np.array([0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 2.0, 1.0])  # the hook, then the point that moves
    effects = [Springs([(0, 1)], 0.3, 8.0), Drag(0.5), Actuation(np.zeros((STEPS, 2, 2)), H)]
    system, goal = System([1.0, 1.0], effects, dimension=2, fixed=[0]), eight()
    moving = np.arange(STEPS * 4).reshape(STEPS, 2, 2)[:, 1].ravel()
    variables = Variables(system, start, {"actuation.forces": moving})

    def run(p: Array) -> tuple[float, Array, Array]:
        steered, y0 = variables.place(p)
        trajectory = simulate(SymplecticEuler(), steered, y0, H, STEPS)
        path = trajectory.y[:, 2:4]
        loads = np.zeros_like(trajectory.y)
        loads[:, 2:4] = path - goal  # a cost at every state, not only the last
        slope = variables.gather(adjoint(trajectory, loads)) + PRICE * p
        return 0.5 * float(np.sum((path - goal) ** 2)) + 0.5 * PRICE * float(p @ p), slope, path

    found = optimise(lambda p: run(p)[:2], variables.start, options={"maxiter": 15})
    return found, run(variables.start)[2], run(found.p)[2], found.p.reshape(STEPS, 2)


@style()
def discrete_adjoint() -> Figure:
    """Path and forces, before and after; the cost at every evaluation."""
    found, free, path, forces = steering()
    figure, (left, right) = canvas(1, 2, size=(9.0, 4.4), width_ratios=[1.6, 1])
    left.plot(*eight().T, color="#b0b7bf", linewidth=7, label="target, at every state")
    left.plot(*free.T, color=COLOURS[1], linestyle="--", label="without forces")
    left.plot(*path.T, color=COLOURS[0], linestyle="-", marker="o", markersize=3, label="steered")
    left.quiver(*path[1:].T, *forces.T, color=COLOURS[2], width=0.004, scale=120.0, zorder=3)
    left.plot([], [], color=COLOURS[2], marker=r"$\rightarrow$", linestyle="", markersize=14, label="forces")
    left.plot([0], [0.6], "s", color="#1f2328", markersize=8)
    left.annotate("hook", (0, 0.6), (0.06, 0.66), fontsize=9)
    label(left, "x (m)", "y (m)", "Forces of 40 steps, found by the adjoint")
    left.set_aspect("equal")
    left.legend(loc="lower center", fontsize=8, ncols=4)
    left.set(xlim=(-1.2, 1.2), ylim=(-0.85, 0.95))
    right.semilogy(np.arange(1, found.evaluations + 1), found.best, color=COLOURS[0])
    label(right, "gradients", "least cost so far (m²)", "One sweep back a gradient")
    return figure
