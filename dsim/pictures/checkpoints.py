"""The staircase of binomial checkpointing: which states are kept, which steps are taken again, and when."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dsim.pictures.style import COLOURS, canvas, label, style
from dsim.steppers.checkpoints import Checkpoints

Line = tuple[tuple[float, float], tuple[float, float]]  # (step, work) to (step, work)


class Staircase(NamedTuple):
    """What a schedule draws: work counts steps taken and steps pulled back, in their order."""

    advances: list[Line]
    pulls: list[Line]
    kept: list[Line]  # from the snapshot to where it is forgotten
    work: int


def staircase(checkpoints: Checkpoints, steps: int) -> Staircase:
    """The lines of a schedule; a "finish" is the last step of the run."""
    advances: list[Line] = []
    pulls: list[Line] = []
    kept: list[Line] = []
    born: dict[int, int] = {}
    work = 0
    for action in checkpoints.schedule(steps):
        n = action.n
        if action.kind in ("advance", "finish"):
            until = max(action.until, n + 1)
            advances.append(((n, work), (until, work + until - n)))
            work += until - n
        elif action.kind == "pull":
            pulls.append(((n + 1, work), (n, work + 1)))
            work += 1
        elif action.kind == "snapshot":
            born[n] = work
        elif action.kind == "forget":
            kept.append(((n, born.pop(n)), (n, work)))
    kept += [((n, start), (n, work)) for n, start in born.items()]
    return Staircase(advances, pulls, kept, work)


@style()
def schedule(steps: int = 60, snapshots: int = 4, whole: int = 1001) -> Figure:
    """Left: one schedule in time.  Right: what fewer snapshots cost a run of `whole` steps."""
    figure, (left, right) = canvas(1, 2, size=(11.5, 5.2), width_ratios=[3, 2])
    checkpoints = Checkpoints(snapshots)
    _draw(left, staircase(checkpoints, steps), steps)
    title = f"{steps} steps, {snapshots} states: none taken more than {checkpoints.most(steps)} times"
    label(left, "step n", "steps taken and pulled back so far", title)
    counts = np.unique(np.geomspace(1, whole, 60).round().astype(int))
    advances = [Checkpoints(int(s)).advances(whole) / whole for s in counts]
    right.loglog(counts, advances, color=COLOURS[0])
    at = min(10, whole)
    there = Checkpoints(at)
    right.plot(at, there.advances(whole) / whole, "o", color=COLOURS[1])
    words = f"{at} states: {there.advances(whole)} steps,\nnone more than {there.most(whole)} times"
    right.annotate(words, (at, there.advances(whole) / whole), (14, 18), textcoords="offset points", fontsize=10)
    label(right, "states kept at a time", "steps taken, per step of the run", f"{whole} steps: memory against work")
    return figure


def _draw(axes: Axes, stairs: Staircase, steps: int) -> None:
    looks = (("state kept", stairs.kept, "#b0b7bf", 3.0), ("step taken", stairs.advances, COLOURS[0], 1.6),
             ("step pulled back", stairs.pulls, COLOURS[1], 2.6))  # fmt: skip
    for name, lines, colour, width in looks:
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=width, label=name))
    axes.set_xlim(-0.02 * steps, 1.02 * steps)
    axes.set_ylim(stairs.work * 1.02, -0.02 * stairs.work)  # time runs down
    axes.legend(loc="lower right")
