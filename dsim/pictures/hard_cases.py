"""Pictures of hard cases: the naive method on the left, the one that survives on the right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsim.pictures.style import canvas, label, look, style
from dsim.studies.hard_cases import Curve, HardCase, HardCaseResult, Panel


@style()
def side_by_side(case: HardCase, result: HardCaseResult) -> Figure:
    """Both panels of a case, with its number and title above."""
    figure, axes = canvas(columns=2, size=(11.0, 4.6))
    figure.suptitle(f"{case.number}. {case.title[0].upper()}{case.title[1:]}", x=0.01, ha="left", weight="bold")
    for half, panel in zip(axes, result.panels, strict=True):
        _panel(half, panel)
    return figure


def _panel(axes: Axes, panel: Panel) -> None:
    label(axes, panel.x, panel.y, panel.title)
    if _huge(panel):
        panel = _exponents(axes, panel)
    else:
        axes.set_yscale(panel.scale)
    if panel.contours:
        axes.contour(*panel.contours, levels=24, colors="#8c959f", linewidths=0.6, linestyles="-")
    for number, curve in enumerate(panel.curves):
        _curve(axes, curve, number)
    if panel.equal:
        axes.set_aspect("equal", adjustable="datalim" if not panel.contours else "box")
    if panel.note:
        axes.text(
            0.0, -0.17, panel.note, transform=axes.transAxes, ha="left", va="top", fontsize=10, color="#57606a",
        )  # fmt: skip
    if any(curve.points for curve in panel.curves):  # points fill a panel: the legend stands below it
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, -0.12), ncols=2, fontsize=9)
    elif panel.curves:
        axes.legend(loc="best", fontsize=9)


def _huge(panel: Panel) -> bool:
    """Whether the ticks of a logarithmic axis would themselves overflow."""
    return panel.scale == "log" and any(c.y[np.isfinite(c.y)].max(initial=0.0) > 1e200 for c in panel.curves)


def _exponents(axes: Axes, panel: Panel) -> Panel:
    """The panel with log10 y on a linear axis, whose ticks read 10^0, 10^50, ..."""
    axes.yaxis.set_major_formatter(lambda value, _: f"$10^{{{value:.0f}}}$")
    with np.errstate(divide="ignore"):
        curves = [replace(c, y=np.where(c.y > 0, np.log10(c.y), np.nan)) for c in panel.curves]
    return replace(panel, scale="linear", curves=tuple(curves))


def _curve(axes: Axes, curve: Curve, number: int) -> None:
    """A line gets a few markers only: enough to tell it without its colour."""
    looks = look(number)
    if curve.points:
        axes.plot(curve.x, curve.y, **looks | {"linestyle": "none", "markersize": 4.5}, label=curve.label)
        return
    count = int(np.isfinite(curve.y).sum())
    looks |= {"marker": looks["marker"] if count <= 30 else "", "markersize": 4.5}
    axes.plot(curve.x, curve.y, **looks, label=curve.label)
