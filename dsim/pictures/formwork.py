"""Fabric formwork before and after its design: shapes, distances from the target, and the pattern that was found."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dsim.arrays.checks import Array
from dsim.gradients.quasistatic import Equilibrium
from dsim.pictures.scene import FAINT, STRAIN, projected
from dsim.pictures.style import canvas, label, look, style
from dsim.studies.showcases.formwork import SPAN, Formwork, TwoBellies

_LIFT = 3.0  # heights are drawn so much larger: a belly of a tenth of the span must be seen


@style()
def before_after(result: Formwork) -> Figure:
    """Above: the uniform fabric and the designed one, coloured by their distance from the target, and the distance on
    the way.  Below: rest lengths and stiffnesses of the designed threads, and a section through both fabrics."""
    figure, axes = canvas(2, 3, (14.0, 8.0), width_ratios=(1.15, 1.15, 1.0), height_ratios=(0.75, 1.0))
    distances = [1e3 * result.problem.distance(found) for found in (result.before, result.after)]
    norm = LogNorm(max(1e-3, float(np.quantile(distances[1], 0.05))), float(distances[0].max()))
    shapes = (("Uniform fabric", result.before), ("Designed fabric", result.after))
    for panel, (name, found), distance in zip(axes[0], shapes, distances, strict=False):
        _shape(panel, result, found, distance, norm)
        panel.set_title(f"{name}: RMS {1e3 * SPAN * result.rms(found):.2g} mm off")
    bar = ScalarMappable(norm, "viridis")
    figure.colorbar(bar, ax=list(axes[0, :2]), label="distance from the target (mm)", fraction=0.03, pad=0.01)
    _progress(axes[0, 2], result)
    _pattern(figure, axes[1, 0], result, "rest length (% of the start's)", _rest(result))
    _pattern(figure, axes[1, 1], result, "stiffness (log10, relative to the start's)", _stiffness(result))
    _section(axes[1, 2], result)
    (freedom, unknowns), count = result.problem.fabric.unknowns, result.optimisation.evaluations
    figure.suptitle(
        f"Fabric formwork: {freedom} degrees of freedom, {unknowns} unknowns, {count} equilibria",
        x=0.01, ha="left", weight="bold",
    )  # fmt: skip
    return figure


def _shape(axes: Axes, result: Formwork, found: Equilibrium, distance: Array, norm: Any) -> None:
    """The threads along both directions, coloured, in front of the frame."""
    fabric = result.problem.fabric
    x = found.q.reshape(-1, 3) * [1.0, 1.0, _LIFT]
    places, depth = projected(x)
    colours = np.full(len(x), np.nan)
    colours[fabric.inner] = distance
    straight = np.abs(np.diff(fabric.flat[fabric.edges, :2], axis=1)[:, 0]).min(axis=1) < 1e-9
    edges = fabric.edges[straight]
    edges = edges[np.argsort(depth[edges].sum(axis=1), kind="stable")]
    lines = LineCollection(list(places[edges]), linewidths=1.4, capstyle="round", cmap="viridis", norm=norm)
    lines.set_array(np.nanmean(colours[edges], axis=1))
    axes.add_collection(lines)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]]) * SPAN / 2
    axes.plot(*projected(corners)[0].T, color=FAINT, linewidth=2.5, linestyle="-", zorder=0)
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.text(0.0, -0.05, f"frame {SPAN:g} m x {SPAN:g} m, heights x {_LIFT:g}", transform=axes.transAxes, fontsize=9)


def _progress(axes: Axes, result: Formwork) -> None:
    axes.semilogy(np.arange(1, len(result.distances) + 1), result.distances, **look(0) | {"markersize": 3.5})
    label(axes, "equilibrium", "RMS distance / span", "On the way")


def _rest(result: Formwork) -> Array:
    rest, _ = result.problem.parameters(result.z)
    percent: Array = 100 * rest / result.problem.rest
    return percent


def _stiffness(result: Formwork) -> Array:
    _, stiffness = result.problem.parameters(result.z)
    exponent: Array = np.log10(stiffness / result.problem.stiffness)
    return exponent


def _pattern(figure: Figure, axes: Axes, result: Formwork, name: str, values: Array) -> None:
    """Every thread where it lies in the flat fabric, the strongest last."""
    fabric = result.problem.fabric
    middle = 100.0 if values.min() > 50 else 0.0
    half = float(np.abs(values - middle).max()) or 1.0
    norm = Normalize(middle - half, middle + half)
    order = np.argsort(np.abs(values - middle), kind="stable")
    segments = fabric.flat[fabric.edges[order], :2]
    axes.add_collection(LineCollection(list(segments), array=values[order], cmap=STRAIN, norm=norm, linewidths=1.3))
    axes.set(xlim=(-SPAN / 2, SPAN / 2), ylim=(-SPAN / 2, SPAN / 2), aspect="equal")
    axes.grid(False)
    label(axes, "x (m)", "y (m)", "Pattern: " + name.split(" (")[0])
    figure.colorbar(ScalarMappable(norm, STRAIN), ax=axes, label=name, fraction=0.046, pad=0.02)


def _section(axes: Axes, result: Formwork) -> None:
    """Along the middle row of points, from frame to frame."""
    fabric, target = result.problem.fabric, result.problem.target
    row = np.flatnonzero(np.arange(fabric.n**2) % fabric.n == fabric.n // 2)
    for number, (name, found) in enumerate((("uniform", result.before), ("designed", result.after))):
        x = found.q.reshape(-1, 3)[row]
        axes.plot(x[:, 0], x[:, 2], **look(number) | {"markersize": 4}, label=name)
    if isinstance(target, TwoBellies):
        x = np.linspace(-SPAN / 2, SPAN / 2, 101)
        axes.plot(x, target.height(x, np.zeros_like(x)), color="#000000", linestyle=":", label="target")
    axes.legend(loc="best")
    label(axes, "x (m)", "height (m)", "Section through the middle")
