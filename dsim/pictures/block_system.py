"""dG/dx and dG/dp as the lecture draws them: which step feels which state and which parameter.

Lecture: "What about dynamics?".
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dsim.arrays.checks import Array
from dsim.gradients import BlockSystem
from dsim.pictures.style import COLOURS, canvas, label, style

PLUS, MINUS = COLOURS[0], COLOURS[1]  # blue and vermillion
LINE = "#57606a"
SHORT = {"gravity.acceleration": "gravity", "drag.coefficient": "drag", "drag.wind": "wind",
         "springs.rest_length": "rest length", "springs.stiffness": "stiffness",
         "spring_damping.coefficient": "damping"}  # fmt: skip


@style()
def spy(whole: BlockSystem) -> Figure:
    """dG/dx on the left, dG/dp on the right: blue where positive, vermillion where negative, white where zero.

    Lines part the steps; in dG/dp also the kinds of parameters, and the steps of actuation.
    """
    height, width = whole.dGdp.shape
    side = 4.2
    figure, axes = canvas(1, 2, size=(side * (1 + width / height) + 1.2, side + 2.0), width_ratios=(height, width))
    steps = whole.ticks, _rows(whole)
    name = type(whole.trajectory.stepper).__name__
    for panel, matrix, columns in zip(axes, (whole.dGdx, whole.dGdp), (steps, _columns(whole)), strict=True):
        _panel(panel, matrix, steps, columns)
    label(axes[0], "states (m, m/s)", "equations of step", f"{name}: dG/dx")
    label(axes[1], "parameters", "equations of step", "dG/dp")
    axes[1].set_ylabel("")
    axes[1].tick_params(axis="x", labelrotation=90)
    signs = [Patch(color=PLUS, label="positive"), Patch(color=MINUS, label="negative")]
    figure.legend(handles=signs, loc="outside lower left", ncols=2, frameon=False)
    return figure


def _rows(whole: BlockSystem) -> list[str]:
    """The steps by the state they make; "past" for the one before the start that a two-step method makes up."""
    steps = len(whole.trajectory.t) - 1
    return ["past"] * (len(whole.ticks) - 1 - steps) + [f"$x_{{{n}}}$" for n in range(1, steps + 1)]


def _columns(whole: BlockSystem) -> tuple[Array, list[str]]:
    """First columns of the kinds of parameters, with the end; and their names.  One kind a step for actuation."""
    system: Any = whole.trajectory.system
    names, widths = ["start $x_0$"], [system.size]
    for name, part in system.split(np.arange(system.parameter_count)).items():
        if name.endswith(".forces"):
            names += [f"force {n}" for n in range(len(part))]
            widths += [part[0].size] * len(part)
        else:
            names.append(SHORT.get(name, name))
            widths.append(part.size)
    return np.concatenate([[0], np.cumsum(widths)]), names


def _panel(axes: Axes, matrix: Any, rows: tuple[Array, list[str]], columns: tuple[Array, list[str]]) -> None:
    """Squares where an entry is not zero, and a line between blocks."""
    height, width = matrix.shape
    values = matrix.toarray()
    picture = np.ones((height, width, 3))
    picture[values > 0], picture[values < 0] = to_rgb(PLUS), to_rgb(MINUS)
    axes.imshow(picture, extent=(0, width, height, 0), interpolation="nearest", aspect="auto")
    axes.grid(visible=False)
    for draw, (ticks, _) in ((axes.axhline, rows), (axes.axvline, columns)):
        for place in ticks[1:-1]:
            draw(place, color=LINE, linewidth=0.7, linestyle="-", marker="")
    axes.spines[["top", "right"]].set_visible(True)
    _label(axes.yaxis, rows)
    _label(axes.xaxis, columns)


def _label(axis: Any, blocks: tuple[Array, list[str]]) -> None:
    """Names in the middle of the blocks."""
    ticks, names = blocks
    axis.set_ticks((ticks[1:] + ticks[:-1]) / 2, names, fontsize=9)
    axis.set_tick_params(length=0)
