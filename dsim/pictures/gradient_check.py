"""The V-curve: disagreement of differences and gradient over the step."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsim.pictures.style import canvas, label, look, style
from dsim.studies.gradient_check import GradientReport


@style()
def v_curve(report: GradientReport, title: str = "") -> Figure:
    """|central difference - gradient| over the step for the worst direction and two others, on log-log axes.

    Truncation falls from the right, round-off rises to the left; a wrong gradient leaves a floor between them.
    """
    figure, axes = canvas()
    truth = report.given if report.given is not None else report.numerical
    name = "gradient" if report.given is not None else "best estimate"
    others = [i for i in range(len(report.labels)) if i != report.worst_index][:2]
    for number, row in enumerate([report.worst_index, *others]):
        size = max(abs(truth[row]), np.abs(truth).max() * 1e-12, np.finfo(float).tiny)
        error = np.abs(report.central[row] - truth[row]) / size
        error = np.where(np.isfinite(error), np.maximum(error, 1e-17), np.nan)
        text = report.labels[row] + (" (worst)" if number == 0 else "")
        axes.loglog(report.steps[row], error, **look(number), label=text, alpha=1.0 if number == 0 else 0.6)
    low, high = report.window
    if 0 < low:
        axes.axvspan(low / 1.2, high * 1.2, color="#E69F00", alpha=0.2, label="steps judged on", lw=0)
    label(axes, "step (units of x)", f"|difference - {name}| / |{name}|", title or f"verdict: {report.verdict}")
    axes.legend(loc="best")
    return figure
