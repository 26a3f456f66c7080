"""Pictures beside a student's feedback.  Their numbers may be anything; the picture is small and always drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from dsim.arrays.checks import Array
from dsim.pictures.style import COLOURS, label, look, style, to_png

DPI = 80
MOST_VALUE = 1e12
MOST = 400  # entries or points of a line that are drawn
FEW = 36  # entries of a matrix that are written as numbers
FAR = 1e3  # times the largest expected value: what is farther off lies at the edge


def entries(name: str, expected: Array, found: Array, tolerance: float, values: bool) -> bytes:
    """Yours and expected by entry (where `values` may be shown), and the error of each entry with the tolerance."""
    expected = np.clip(np.asarray(expected, float), -MOST_VALUE, MOST_VALUE)
    found = np.asarray(found, float)
    reach = FAR * max(1.0, float(np.abs(expected).max(initial=0.0)))
    found = np.clip(np.nan_to_num(found, nan=reach, posinf=reach, neginf=-reach), -reach, reach)
    draw = _matrices if expected.ndim == 2 and min(expected.shape) > 1 else _rows
    with style():
        return to_png(draw(name, (expected, found), tolerance, values), DPI)


def _panels(count: int, name: str) -> tuple[Figure, list[Axes]]:
    """Panels side by side, placed by hand: a layout that measures every text takes most of the time of a picture."""
    # "none" from the start: chosen later, it forbids subplots_adjust and warns.
    figure = Figure(figsize=(4.4 * count, 3.4), layout="none")  # type: ignore[arg-type]
    axes = list(figure.subplots(1, count, squeeze=False)[0])
    figure.subplots_adjust(left=0.9 / (4.4 * count), right=0.985, bottom=0.155, top=0.82, wspace=0.3)
    figure.suptitle(name, fontsize=11)
    return figure, axes


def _rows(name: str, pair: tuple[Array, Array], tolerance: float, values: bool) -> Figure:
    expected, found = (z.ravel()[:MOST] for z in pair)
    figure, axes = _panels(1 + values, name)
    index, last = np.arange(expected.size), axes[-1]
    if values:
        axes[0].plot(index, expected, "o", color="#b0b7bf", markersize=11, label="expected")
        axes[0].plot(index, found, "x", color=COLOURS[1], markeredgewidth=2, label="yours")
        label(axes[0], "entry", "value")
    error = np.maximum(np.abs(found - expected), 1e-17)
    last.semilogy(index, error, "x", color=COLOURS[1], markeredgewidth=2, label="error of yours")
    last.axhline(max(tolerance, 1e-17), color=COLOURS[0], linestyle="--", label="allowed")
    label(last, "entry", "|yours - expected|")
    for panel in axes:
        panel.legend(
            fontsize=9, ncols=2, frameon=False, loc="lower left", bbox_to_anchor=(-0.02, 0.97)
        )  # hides nothing
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _matrices(name: str, pair: tuple[Array, Array], tolerance: float, values: bool) -> Figure:
    figure, axes = _panels(1 + values, f"{name} (orange: below 0, purple: above)" if values else name)
    size = [float(np.abs(matrix).max(initial=0.0)) for matrix in pair]
    limit = min(max(size), 3 * size[0] or 1.0) or 1.0
    off = np.abs(pair[1] - pair[0]) > tolerance
    if values:
        _cells(axes[0], pair[0], limit, "expected")
        _cells(axes[-1], pair[1], limit, "yours; framed: off")
    else:
        axes[-1].imshow(off, cmap="binary", vmin=0, vmax=2)
        label(axes[-1], "column", "row", "grey: off")
    for row, column in np.argwhere(off)[:MOST]:
        frame = Rectangle((column - 0.47, row - 0.47), 0.94, 0.94, fill=False, edgecolor="black", linewidth=2)
        axes[-1].add_patch(frame)
    for panel in axes:
        panel.grid(False)
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _cells(panel: Axes, matrix: Array, limit: float, title: str) -> None:
    panel.imshow(matrix, cmap="PuOr", vmin=-limit, vmax=limit, aspect="auto")
    label(panel, "column", "row", title)
    if matrix.size <= FEW:
        for (row, column), value in np.ndenumerate(matrix):
            colour = "white" if abs(value) > 0.6 * limit else "black"
            panel.text(column, row, f"{value:.3g}", ha="center", va="center", fontsize=9, color=colour)


def lines(title: str, axes: tuple[str, str], drawn: Sequence[tuple[str, Any, Any]], log: str) -> bytes:
    """Curves with a legend; what is not finite is left out.  log: "", "y" or "xy"."""
    with style():
        figure, (panel,) = _panels(1, title)
        names = list(dict.fromkeys(name for name, _, _ in drawn))
        for curve, (name, x, y) in enumerate(drawn):
            again = name in [before for before, _, _ in drawn[:curve]]  # one look, and one row of the legend
            x, y = np.asarray(x, float)[-MOST:], np.clip(np.asarray(y, float)[-MOST:], -MOST_VALUE, MOST_VALUE)
            good = np.isfinite(x) & np.isfinite(y)
            if log:
                good &= (y > 0) & ((x > 0) | (log == "y"))
            kind = {"": panel.plot, "y": panel.semilogy, "xy": panel.loglog}[log]
            marker = {} if x.size <= 30 else {"marker": ""}
            kind(x[good], y[good], label="_" if again else name, **{**look(names.index(name)), **marker})
        if log != "xy" and np.array_equal(drawn[0][1], np.round(drawn[0][1])):
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        if log == "xy" and len(steps := np.unique(drawn[0][1])) <= 4:  # the steps themselves: labels of decades collide
            panel.set_xticks(steps, [f"{step:.3g}" for step in steps])
            panel.set_xticks([], minor=True)
        label(panel, *axes)
        panel.legend(fontsize=9)
        return to_png(figure, DPI)
