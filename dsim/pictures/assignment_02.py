"""The picture of success of assignment 02."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsim.effects import Springs
from dsim.pictures.style import COLOURS, canvas, label, style
from dsim.scenes.nets import lattice
from dsim.system import System


@style()
def springs() -> Figure:
    """A small net with the forces of its springs, and the pattern of its stiffness matrix."""
    x, threads, diagonals = lattice((5, 5), 0.25)
    pairs = np.concatenate([threads, diagonals])
    rest = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    moved = x + 0.06 * np.random.default_rng(4).normal(size=x.shape)
    system = System(np.ones(25), [Springs(pairs, rest, 40.0)], dimension=2)
    force = system.force(0.0, moved.ravel(), np.zeros(50)).reshape(-1, 2)
    figure, axes = canvas(1, 2, size=(9.0, 4.4))
    for i, j in pairs:
        axes[0].plot(*moved[[i, j]].T, color="#b0b7bf", linestyle="-", linewidth=1.0)
    axes[0].plot(*moved.T, "o", color=COLOURS[0])
    axes[0].quiver(*moved.T, *force.T, color=COLOURS[1], width=0.006)
    label(axes[0], "x (m)", "y (m)", "Points, springs and their forces")
    axes[0].set_aspect("equal")
    axes[1].spy(system.dq(0.0, moved.ravel(), np.zeros(50)), markersize=2.0, color=COLOURS[0])
    label(axes[1], "column (coordinate)", "row (coordinate)", "The stiffness matrix of the net")
    return figure
