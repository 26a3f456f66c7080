"""The look of every picture: colours that survive colour blindness, a marker and a dash for each line.

    @style()
    def draw(...) -> Figure:
        figure, axes = canvas()
        axes.loglog(h, error, **look(0), label="backward Euler")
        label(axes, "step size h (s)", "error (m)")
        return figure

Figures are made without pyplot: no global list of figures, no window, no backend to choose, nothing to close.
The background is opaque white, so a picture reads the same on a light and on a dark page.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from dsim.pictures.files import write_atomically

# Okabe and Ito (2008), darkest first; their yellow is left out: on white it cannot be read as a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":")

FORMATS = ("svg", "png")

_RC: dict[Any, Any] = {
    "figure.facecolor": "white",
    "figure.figsize": (7.0, 4.2),
    "figure.dpi": 100,
    "figure.constrained_layout.use": True,
    "savefig.facecolor": "white",
    "axes.facecolor": "white",
    "axes.edgecolor": "#57606a",
    "axes.labelcolor": "#1f2328",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 11,
    "axes.prop_cycle": cycler(color=COLOURS) + cycler(linestyle=(DASHES * 2)[: len(COLOURS)]),
    "grid.color": "#d8dee4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.8,
    "lines.markersize": 5.5,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "xtick.color": "#57606a",
    "ytick.color": "#57606a",
    "xtick.labelcolor": "#1f2328",
    "ytick.labelcolor": "#1f2328",
    "legend.fontsize": 10,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "#d8dee4",
    "font.size": 11,
    "font.family": "DejaVu Sans",  # ships with matplotlib: the same picture on every machine
    "svg.fonttype": "path",
    "svg.hashsalt": "dsim",  # equal figures give equal bytes
}


@contextmanager
def style() -> Iterator[None]:
    """Draw with the shared look; a `with` block, or a decorator `@style()` of a drawing function."""
    with matplotlib.rc_context(_RC):
        yield


def look(index: int) -> dict[str, Any]:
    """Colour, marker and dash of the `index`-th curve, so that one method looks the same in every picture.

    >>> look(1)
    {'color': '#D55E00', 'marker': 's', 'linestyle': '--'}
    """
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": DASHES[index % len(DASHES)],
    }


def canvas(
    rows: int = 1, columns: int = 1, size: tuple[float, float] = (7.0, 4.2), **subplots: Any
) -> tuple[Figure, Any]:
    """A figure of `size` inches and its axes: one Axes, or an array of them.  Call it inside `style()`."""
    figure = Figure(figsize=size)
    return figure, figure.subplots(rows, columns, **subplots)


def label(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name both axes, with units in brackets: `label(axes, "time (s)", "height (m)")`."""
    for name, text in (("x", x), ("y", y)):
        if not text.strip():
            raise ValueError(f"the {name} axis must have a label with its unit; got {text!r}")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    if title:
        axes.set_title(title)


def to_svg(figure: Figure) -> bytes:
    """The picture as SVG: for curves."""
    with _drawing(figure, 72) as buffer:
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
        return buffer.getvalue()


def to_png(figure: Figure, dpi: int = 160) -> bytes:
    """The picture as PNG: for images and for more points than an SVG should hold."""
    with _drawing(figure, dpi) as buffer:
        FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})
        return buffer.getvalue()


def save(figure: Figure, path: str | Path, dpi: int = 160) -> Path:
    """Write `figure` to `path` (.svg or .png), completely or not at all, and release it."""
    kind = Path(path).suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise ValueError(f"path must end in .svg or .png; got {str(path)!r}")
    data = to_svg(figure) if kind == "svg" else to_png(figure, dpi)
    figure.clear()
    return write_atomically(path, data)


@contextmanager
def _drawing(figure: Figure, dpi: float) -> Iterator[io.BytesIO]:
    """Where the bytes go that `figure.savefig` would give, but drawn once instead of twice."""
    resolution, canvas = figure.dpi, figure.canvas
    figure.set_dpi(dpi)
    try:
        with style(), io.BytesIO() as buffer:
            yield buffer
    finally:
        figure.set_canvas(canvas)
        figure.set_dpi(resolution)
