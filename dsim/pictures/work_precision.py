"""Pictures of what accuracy costs: error over cost with failures marked, Newton's tolerance, the V of differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from dsim.arrays.checks import Array
from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.studies.work_precision import BLOWN_UP, QUANTITIES, Cell, Study

TITLES = {"state": "error of the state", "gradient": "error of the gradient"}
COSTS = {
    "seconds": {"state": "seconds of the run", "gradient": "seconds of run and gradient"},
    "forces": {"state": "force evaluations of the run", "gradient": "force evaluations of the run"},
}


@style()
def work_precision(study: Study) -> Figure:
    """Error over cost, states on the left, gradients on the right; failed runs are crosses at the top edge."""
    figure, axes = canvas(1, 2, size=(11.0, 4.9), sharey=True)
    for panel, quantity in zip(axes, QUANTITIES, strict=True):
        _panel(panel, study, quantity)
        label(panel, COSTS[study.unit][quantity], "largest scaled error", f"{study.problem}: {TITLES[quantity]}")
    axes[1].set_ylabel("")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=6, fontsize=9)
    return figure


def _panel(axes: Axes, study: Study, quantity: str) -> None:
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))  # two labels a decade: more run into each other
    axes.xaxis.set_minor_formatter("")
    axes.set_yscale("log")
    top = max(_top(study, q) for q in QUANTITIES)
    for number, method in enumerate(study.methods):
        cost, error = study.points(method, quantity)
        axes.plot(cost, error, **_look(number), label=method)
        _failures(axes, study, method, _look(number)["color"], top)
    front = study.front(quantity)
    axes.plot(
        [c.cost(quantity, study.unit) for c in front],
        [max(c.error_of(quantity), study.floor(quantity)) for c in front],
        color="#57606a", linewidth=7, alpha=0.22, solid_capstyle="round", zorder=0, label="Pareto front",
    )  # fmt: skip
    floor = study.floor(quantity)
    low = min(_least(study, q) for q in QUANTITIES) / 5
    if floor > low:
        axes.axhspan(low, floor, color="#d8dee4", alpha=0.6, zorder=0)
        where = axes.get_yaxis_transform()
        axes.text(0.98, floor, "below: truth not known well enough", transform=where, fontsize=8, ha="right", va="top")
    axes.set_ylim(low, 4 * top)


def _look(number: int) -> dict[str, Any]:
    """Eleven methods: filled markers first, hollow ones once the colours repeat."""
    found = look(number)
    return {**found, "markerfacecolor": found["color"] if number < len(COLOURS) else "white"}


def _top(study: Study, quantity: str) -> float:
    errors = [c.error_of(quantity) for c in study.cells if not c.failed]
    return float(min(BLOWN_UP, 3 * max(errors, default=1.0)))


def _least(study: Study, quantity: str) -> float:
    return float(min((study.points(m, quantity)[1].min(initial=1.0) for m in study.methods), default=1.0))


def _failures(axes: Axes, study: Study, method: str, colour: object, top: float) -> None:
    """Crosses at the top edge, above the cost that the same number of steps has elsewhere in the sweep."""
    failed = [c for c in study.of(method) if c.failed]
    cost = [estimated_cost(study, cell) for cell in failed]
    axes.plot(cost, [2 * top] * len(cost), color=colour, marker="x", markersize=8, markeredgewidth=2, linestyle="")


def estimated_cost(study: Study, failed: Cell) -> float:
    """What a failed run would have cost: a finished run of the method scaled by its steps, or of any method."""
    finished = [c for c in study.of(failed.method) if not c.failed] or [c for c in study.cells if not c.failed]
    per_step = [c.cost("state", study.unit) / c.steps for c in finished if c.steps]
    return failed.steps * float(np.median(per_step)) if per_step else 1.0


@style()
def newton_tolerance(curves: Mapping[str, tuple[Array, Array, Array]]) -> Figure:
    """The error over Newton's tolerance, and below it, thin, the part that the tolerance is to blame for."""
    figure, axes = canvas()
    for number, (name, (tol, error, algebraic)) in enumerate(curves.items()):
        axes.loglog(tol, error, **look(number), label=f"{name}, error")
        part = {**look(number), "linewidth": 1.0, "markerfacecolor": "white"}
        axes.loglog(tol, np.maximum(algebraic, 1e-17), **part, label="of it, Newton's share")
    axes.invert_xaxis()
    label(axes, "Newton's tolerance (relative)", "largest scaled error", "A tolerance is not an error")
    axes.legend()
    return figure


@style()
def difference_steps(steps: Array, errors: Mapping[str, Array]) -> Figure:
    """The V: round-off on the left, truncation on the right."""
    figure, axes = canvas()
    for number, (name, error) in enumerate(errors.items()):
        axes.loglog(steps, np.maximum(error, 1e-17), **look(number), label=name)
    label(axes, "step of the difference", "relative error of the derivative", "Finite differences")
    axes.legend()
    return figure
