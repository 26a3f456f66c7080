"""Pictures of what gradients cost and of how they converge."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from dsim.pictures.style import COLOURS, MARKERS, canvas, label, style
from dsim.studies.gradient_cost import METHODS, CostStudy
from dsim.studies.gradient_order import observed
from dsim.studies.work_precision import Study

FAINT = "#57606a"


@style()
def gradient_cost(study: CostStudy) -> Figure:
    """Cost over the number of parameters on the left, errors on the right; extrapolated costs are dotted."""
    figure, (left, right) = canvas(1, 2, size=(11.0, 4.9))
    counts = sorted({cell.parameters for cell in study.cells})
    for number, method in enumerate(METHODS):
        look = {"color": COLOURS[number], "marker": MARKERS[number], "linestyle": "-"}
        ran = [(cell.parameters, cell.cost(study.unit)) for cell in study.of(method) if cell.ran]
        left.loglog(*zip(*ran, strict=True), **look, label=method)
        beyond = [(k, study.cost(method, k)[0]) for k in counts if k >= ran[-1][0]]
        if len(beyond) > 1:
            left.plot(*zip(*beyond, strict=True), color=COLOURS[number], linestyle=":", marker="")
        cells = study.of(method)
        right.loglog([c.parameters for c in cells], [max(c.error, 1e-17) for c in cells], **look)
    left.plot([], [], color=FAINT, linestyle=":", marker="", label="not run: extrapolated, a + b k")
    unit = "time (s)" if study.unit == "seconds" else "passes over the trajectory"
    title = f"{study.springs} springs, {study.steps} steps: cost"
    label(left, "number of parameters", unit, title)
    label(right, "number of parameters", "largest relative error", "error of the gradient")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize=9)
    return figure


@style()
def gradient_orders(studies: Mapping[str, Study]) -> Figure:
    """Errors over h, a panel a problem: state filled and solid, gradient hollow and dashed, a colour a method."""
    figure, axes = canvas(1, len(studies), size=(4.1 * len(studies) + 0.4, 5.2), sharey=True, squeeze=False)
    methods = list(dict.fromkeys(m for study in studies.values() for m in study.methods))
    for panel, (title, study) in zip(axes[0], studies.items(), strict=True):
        for method in study.methods:
            number = methods.index(method)
            _both(panel, study, method, (COLOURS[number], MARKERS[number]))
        label(panel, "step size h (s)", "largest scaled error", title)
        panel.set_ylabel("")
        steps = sorted({cell.setting for cell in study.cells})[::2]
        panel.set_xticks(steps, [f"{h:.2g}" for h in steps])
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_minor_locator(NullLocator())
        words = "solid: state, dashed: gradient; their orders"
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "frameon": False}
        panel.legend(fontsize=8.5, title=words, title_fontsize=8.5, **place)
    axes[0, 0].set_ylabel("largest scaled error")
    return figure


def _both(axes: Axes, study: Study, method: str, look: tuple[str, str]) -> None:
    cells = [cell for cell in study.of(method) if not cell.failed]
    h = np.array([cell.setting for cell in cells])
    colour, marker = look
    for quantity, line, face in (("state", "-", colour), ("gradient", "--", "white")):
        error = [max(cell.error_of(quantity), 1e-16) for cell in cells]
        axes.loglog(h, error, color=colour, marker=marker, linestyle=line, markerfacecolor=face)
    words = ", ".join(f"{round(observed(study, method, quantity), 1) + 0.0}" for quantity in ("state", "gradient"))
    axes.plot([], [], color=colour, marker=marker, linestyle="-", label=f"{method}: {words}")
