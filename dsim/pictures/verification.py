"""Pictures of the report: errors of checks, orders of accuracy, Newton's rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.solve.newton import NewtonResult
from dsim.studies.check import Check
from dsim.studies.convergence import OrderFit


@style()
def digits(checks: Sequence[Check]) -> Figure:
    """A row a statement, a dot a check: its error, and the bound as a bar."""
    statements = list(dict.fromkeys(check.statement for check in checks))
    figure, axes = canvas(size=(7.0, 1.2 + 0.34 * len(statements)))
    for row, statement in enumerate(statements):
        same = [check for check in checks if check.statement == statement]
        error = np.array([max(check.measured, 1e-17) for check in same])
        good = np.array([check.passed for check in same])
        spread = row + np.linspace(-0.22, 0.22, len(same))
        axes.scatter(error[good], spread[good], s=14, color=COLOURS[0], marker="o", zorder=3)
        axes.scatter(error[~good], spread[~good], s=36, color=COLOURS[1], marker="X", zorder=4)
        bound = float(same[0].bound.removeprefix("<= "))
        axes.plot([bound, bound], [row - 0.4, row + 0.4], color="#57606a", linestyle="-", marker="", linewidth=2.5)
    axes.set_xscale("log")
    axes.set_xlim(3e-18, None)
    axes.set_yticks(range(len(statements)), statements)
    axes.invert_yaxis()
    label(axes, "relative error (blue dots passed; the bar is the bound)", "checked statement")
    axes.set_ylabel("")
    return figure


@style()
def orders(fits: Mapping[str, tuple[int, OrderFit]], title: str) -> Figure:
    """Largest error over the step size for every method, with triangles of the declared slopes."""
    figure, axes = canvas(size=(7.0, 4.8))
    for number, (name, (order, fit)) in enumerate(fits.items()):
        axes.loglog(fit.h, fit.error, **look(number), label=f"{name}: {fit.order:.2f} ({order})")
    label(axes, "step size h (s)", "largest error (m, m/s)", title)
    axes.legend(
        title="observed order (declared)", fontsize=8.5, title_fontsize=9, loc="center left", bbox_to_anchor=(1, 0.5)
    )
    return figure


@style()
def newton_rates(results: Mapping[str, NewtonResult]) -> Figure:
    """The residual over the iterations: a right Jacobian doubles the digits, a wrong one adds a few."""
    figure, axes = canvas()
    for number, (name, result) in enumerate(results.items()):
        residual = np.maximum(result.residuals, 1e-17)
        axes.semilogy(range(len(residual)), residual, **look(number), label=name)
    label(axes, "iteration", "largest residual (N)")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()
    return figure
