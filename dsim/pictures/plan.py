"""Pictures of plans: which stage runs in which scene, and what an effect costs and changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.planning import Plan
from dsim.studies.effect_cost import PayBack
from dsim.studies.growth import Growth


@style()
def overview(plans: Mapping[str, Plan]) -> Figure:
    """Scenes down, stages across: a disc where a stage is on, a ring where it is off, nothing where there is none."""
    stages = list(dict.fromkeys(line.stage for made in plans.values() for line in made.lines if line.state != "warn"))
    figure, axes = canvas(size=(1.6 + 0.62 * len(stages), 1.9 + 0.36 * len(plans)))
    for row, made in enumerate(plans.values()):
        for line in made.lines:
            if line.state != "warn":
                fill = COLOURS[0] if line.state == "on" else "white"
                axes.plot(stages.index(line.stage), row, "o", markersize=11, color=COLOURS[0], markerfacecolor=fill)
    label(axes, "stage (disc: on, ring: off)", "scene", "Only what the scene calls for")
    axes.set_xticks(range(len(stages)), stages, rotation=40, ha="right")
    axes.set_yticks(range(len(plans)), list(plans))
    axes.set_xlim(-0.6, len(stages) - 0.4)
    axes.set_ylim(len(plans) - 0.4, -0.6)
    return figure


@style()
def pay_back(scene: str, rows: Sequence[PayBack]) -> Figure:
    """Cost to the right, effect on the answer upwards: what lies left and high pays back most."""
    figure, axes = canvas(size=(6.4, 4.2))
    changes = [max(row.change, 1e-6) if np.isfinite(row.change) else 10.0 for row in rows]
    for number, (row, change) in enumerate(zip(rows, changes, strict=True)):
        axes.plot(row.cost, change, **look(number) | {"linestyle": "none", "markersize": 9})
        words = row.effect if np.isfinite(row.change) else f"{row.effect} (without: fails)"
        axes.annotate(words, (row.cost, change), xytext=(8, 4), textcoords="offset points")
    axes.set_yscale("log")
    axes.axvline(1.0, color="#57606a", linewidth=1)
    axes.margins(0.3)
    label(axes, "time with / time without (ratio)", "largest change (share of the motion)", f"{scene}: pay-back")
    return figure


@style()
def growth(found: Sequence[Growth]) -> Figure:
    """Seconds over unknowns and over steps, with the fitted exponents."""
    figure, axes = canvas(1, 2, size=(10.0, 5.0))
    for panel, varied in zip(axes, ("unknowns", "steps"), strict=True):
        for number, row in enumerate(r for r in found if r.varied == varied):
            words = f"{row.kind}: time ~ {row.time_exponent:.2f}, memory ~ {row.memory_exponent:.2f}"
            panel.loglog(row.amounts, row.seconds, **look(number), label=words)
        label(panel, f"{varied} (number)", "time of the run (s)", f"Growth with the {varied}")
        panel.xaxis.set_minor_formatter("")
        panel.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, -0.16))
    return figure
