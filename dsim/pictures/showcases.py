"""Showcases in pictures: filmstrips before and after, stiffness found against true, and convergence."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from dsim.arrays.checks import Array
from dsim.gradients import Optimisation
from dsim.pictures.scene import FAINT, INK, Film, draw_frame, dress, dress_figure, film, projected
from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.scenes import Scene
from dsim.simulation import Trajectory
from dsim.studies.showcases.control import Control
from dsim.studies.showcases.identification import Identification
from dsim.studies.showcases.targeting import BULLSEYE, HAND, Targeting

TARGET, FOUND = COLOURS[5], COLOURS[2]  # orange: what is wanted; green: what was reached


def _films(scene: Scene, pair: tuple[Trajectory, Trajectory], seen: Array) -> tuple[Film, Film]:
    """Both runs on the same axes, with the same colours, in a box that holds `seen` (K,d) too."""
    first, second = (film(scene, trajectory) for trajectory in pair)
    places, _ = projected(seen)
    low = np.min([first.box[0], second.box[0], places.min(axis=0)], axis=0)
    high = np.max([first.box[1], second.box[1], places.max(axis=0)], axis=0)
    limit = max(first.limit, second.limit)
    first, second = (replace(one, box=np.stack([low, high]), limit=limit) for one in (first, second))
    return first, second


@style()
def control(result: Control, frames: int = 6) -> Figure:
    """The trunk at six times: above at rest, below steered; the circle that its tip should run, and where it ran."""
    task = result.trunk
    foot = task.path[:1] * [1.0, 1.0, -0.25]  # room for the scale
    films = _films(task.scene, (result.before, result.after), np.concatenate([task.path, foot]))
    chosen = np.linspace(0, task.scene.steps, frames).round().astype(int)
    width, height = films[0].box[1] - films[0].box[0]
    figure, panels = canvas(
        2, frames, (12.0, 2 * (10.0 / frames * height / width + 0.3) + 0.7), sharex=True, sharey=True
    )
    circle, _ = projected(task.path)
    for row, one, words, miss in zip(panels, films, ("no contraction", "optimised"), result.missed, strict=True):
        run, _ = projected(task.tip_of(one.trajectory))
        for axes, n in zip(row, chosen, strict=True):
            draw_frame(axes, one, int(n))
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            axes.plot(*circle.T, color=TARGET, linestyle="-", linewidth=4.0, alpha=0.55, zorder=1, label="the circle")
            axes.plot(*run[: n + 1].T, color=FOUND, linestyle="-", linewidth=1.4, zorder=6, label="where the tip ran")
            axes.plot(*circle[n], color=TARGET, marker="o", markersize=7, markeredgecolor=INK, zorder=7,
                      linestyle="none", label="where it should be now")  # fmt: skip
        dress(row[0], one)
        row[0].set_ylabel(f"{words}:\nmiss {_length(miss)} RMS", fontsize=10)
    dress_figure(figure, list(panels.flat), films[1])
    figure.legend(*panels[1, -1].get_legend_handles_labels(), loc="lower center", ncols=3, fontsize=9)
    return figure


@style()
def targeting(result: Targeting, frames: int = 6) -> Figure:
    """The net at six times of its flight: above as for a vacuum, below aimed; the frame it should hit."""
    task = result.throw
    ground = np.array([[HAND[0], HAND[1], 0.0], [BULLSEYE[0], BULLSEYE[1], 0.0]])
    films = _films(task.scene, (result.before, result.after), np.concatenate([task.marks, ground]))
    width, height = films[0].box[1] - films[0].box[0]
    figure, panels = canvas(2, 1, (9.0, 2 * (7.6 * height / width + 0.4) + 0.6), sharex=True, sharey=True)
    for axes, one, words, miss in zip(
        panels, films, ("a parabola, as if without air", "optimised"), result.missed, strict=True
    ):
        for n in np.linspace(0, task.scene.steps, frames).round().astype(int):
            draw_frame(axes, one, int(n))
        dress(axes, one)
        _draw_target(axes, task.marks, ground)
        axes.set_title(
            f"{words}: {frames} instants, the corners miss by {_length(miss)} RMS", fontsize=11, fontweight="normal"
        )
    dress_figure(figure, list(panels), films[1])
    return figure


def _draw_target(axes: Axes, marks: Array, ground: Array) -> None:
    """The frame, the pole it stands on, and the line along the ground from the thrower."""
    frame, _ = projected(np.concatenate([marks, marks[:1]]))
    pole, _ = projected(np.stack([ground[1], marks[np.argsort(marks[:, 2])[:2]].mean(axis=0)]))
    line, _ = projected(ground)
    axes.plot(*frame.T, color=TARGET, linestyle="-", linewidth=5.0, alpha=0.7, zorder=2)
    axes.plot(*pole.T, color=TARGET, linestyle="-", linewidth=3.0, alpha=0.7, zorder=2)
    axes.plot(*line.T, color=FAINT, linestyle="--", linewidth=1.0, zorder=0)


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 0.1 else f"{1e3 * metres:.2g} mm"


@style()
def identification(result: Identification) -> Figure:
    """Left: stiffness found against true, with and without noise.  Right: every error with its bar, by the bar."""
    truth, noisy, hidden = result.film.truth, result.noisy, result.film.hidden
    figure, (left, right) = canvas(columns=2, size=(12.0, 5.0), width_ratios=[1.0, 1.5])
    ends = np.array([truth.min() / 1.1, truth.max() * 1.1])
    left.plot(ends, ends, color=FAINT, linestyle="-", linewidth=1.0, label="found = true")
    points: dict[str, Any] = {"linestyle": "none", "markersize": 4.5}
    bars: dict[str, Any] = {"linestyle": "none", "capsize": 2.0, "elinewidth": 1.0, "markersize": 3.5}
    left.errorbar(truth[~hidden], noisy.stiffness[~hidden], noisy.bars[~hidden], color=COLOURS[0], marker="o", **bars,
                  label="noisy film, 95 % bars")  # fmt: skip
    left.plot(truth[~hidden], result.found[~hidden], color=COLOURS[1], marker="x", **points, label="noise-free film")
    _draw_hidden(left, truth[hidden], noisy.stiffness[hidden])
    left.set(xscale="log", yscale="log", xlim=ends, ylim=ends * [0.7, 1.2])
    _plain_ticks(left)
    label(left, "true stiffness (N/m)", "stiffness found (N/m)", "identification of springs")
    left.legend(loc="lower right", fontsize=9)
    _errors(right, result)
    return figure


def _draw_hidden(axes: Axes, truth: Array, found: Array) -> None:
    """Springs of which nothing is known: bars from the bottom to the top."""
    for place in truth:
        axes.axvline(place, color=COLOURS[3], linestyle=":", linewidth=1.6, zorder=0)
    looks: dict[str, Any] = {"color": COLOURS[3], "marker": "D", "linestyle": ":", "linewidth": 1.6, "markersize": 5.0}
    axes.plot(truth, found, **looks | {"linestyle": "none"})
    axes.plot([], [], **looks, label="hidden springs, infinite bars")


def _plain_ticks(axes: Axes) -> None:
    """50, 100, 200 on both logarithmic axes."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(FixedLocator([25.0, 50.0, 100.0, 200.0, 400.0]))
        axis.set_minor_locator(FixedLocator([]))
        axis.set_major_formatter(lambda value, _: f"{value:g}")


def _errors(axes: Axes, result: Identification) -> None:
    truth, noisy = result.film.truth, result.noisy
    error, bars = 100 * (noisy.stiffness / truth - 1), 100 * noisy.bars / truth
    order = np.argsort(bars, kind="stable")[: int(np.isfinite(bars).sum())]
    inside = np.abs(error[order]) <= bars[order]
    place = np.arange(len(order))
    looks: dict[str, Any] = {"linestyle": "none", "capsize": 2.0, "elinewidth": 1.0, "markersize": 3.5}
    for kind, index, words in ((inside, 0, "reaches"), (~inside, 1, "misses")):
        there, words = order[kind], f"{words} the truth ({kind.sum()})"
        axes.errorbar(place[kind], error[there], bars[there], **look(index) | looks, label=words)
    axes.axhline(0.0, color=INK, linewidth=1.0, linestyle="-")
    share = 100 * float(result.coverage.hits[:, ~result.film.hidden].mean())
    title = f"one film; over {result.coverage.draws} films {share:.1f} % of the bars reach the truth"
    label(axes, "springs, by the length of their bars", "error of the stiffness (%)", title)
    axes.legend(loc="upper left", fontsize=9)


@style()
def convergence(found: Optimisation, name: str) -> Figure:
    """The value and the largest entry of the gradient at every evaluation, both on logarithmic axes."""
    figure, (top, bottom) = canvas(2, 1, (7.0, 5.6), sharex=True)
    count = np.arange(1, found.evaluations + 1)
    looks = look(0) | {"marker": "o" if found.evaluations <= 60 else "", "markersize": 3.5}
    top.plot(count, _positive(found.values), **looks, label="at the evaluation")
    top.plot(count, _positive(found.best), **look(1) | {"marker": ""}, label="best so far")
    asked = np.isfinite(found.slopes)
    bottom.plot(count[asked], _positive(found.slopes[asked]), **looks)
    label(top, "evaluation", "objective", f"{name}: convergence of {found.evaluations} evaluations")
    label(bottom, "evaluation", "largest entry of the gradient")
    top.set(yscale="log", xlabel="")
    bottom.set_yscale("log")
    top.legend(loc="lower left", fontsize=9)
    return figure


def _positive(values: Array) -> Array:
    """What a logarithmic axis can show; the rest becomes a gap."""
    shown: Array = np.where(values > 0, values, np.nan)
    return shown
