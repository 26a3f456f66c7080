"""The three verdicts as one picture: digits of every block, errors over h, growth over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from dsim.pictures.style import COLOURS, canvas, label, look, style
from dsim.studies.verdicts import AuditReport


@style()
def verdicts(reports: Sequence[AuditReport]) -> Figure:
    """A colour a program.  A block that is wrong has 0 digits and a cross."""
    figure, (left, middle, right) = canvas(1, 3, size=(13.0, 4.4))
    _digits(left, reports)
    for number, report in enumerate(reports):
        physics, descent = report.physics, report.descent
        if len(physics.h):
            floor = np.maximum(physics.gradient_error, 1e-16)
            middle.loglog(physics.h, floor, **look(number), label=f"{report.name}: {physics.verdict}")
            if physics.state_error is not None:
                middle.loglog(physics.h, np.maximum(physics.state_error, 1e-16), color=COLOURS[number % len(COLOURS)],
                              linestyle=":", marker="")  # fmt: skip
        right.semilogy(descent.t, np.maximum(descent.growth, 1e-16), **look(number),
                       label=f"{report.name}: {descent.verdict}")  # fmt: skip
    label(middle, "step size h (s)", "relative error (dotted: state)", "2 the physics' derivative?")
    label(right, "time T (s)", "norm of dy(T)/dy(0)", "3 does it point downhill?")
    steps = sorted({h for report in reports for h in report.physics.h})
    middle.set_xticks(steps, [f"{h:.2g}" for h in steps])
    middle.xaxis.set_minor_locator(NullLocator())
    for axes in (middle, right):
        if axes.has_data():
            low, high = axes.get_ylim()
            axes.set_ylim(low / 3, high * 3)  # a growth by half is none, an error that falls by 1 % has not fallen
            axes.legend(fontsize=8.5)
    return figure


def _digits(axes: Axes, reports: Sequence[AuditReport]) -> None:
    blocks = list(dict.fromkeys(b.block for report in reports for b in report.program.blocks))
    places, width = np.arange(len(blocks)), 0.8 / max(1, len(reports))
    for number, report in enumerate(reports):
        found = {b.block: b for b in report.program.blocks}
        at = places + (number - (len(reports) - 1) / 2) * width
        digits = [found[name].digits if name in found else 0.0 for name in blocks]
        axes.barh(at, digits, 0.9 * width, color=COLOURS[number % len(COLOURS)], label=report.name)
        bad = [(p, found[n]) for p, n in zip(at, blocks, strict=True) if n in found and not found[n].digits]
        for place, block in bad:
            since = f" from step {block.first_bad_step}" if block.first_bad_step else ""
            axes.plot(0.15, place, "x", color="#000000", clip_on=False)
            axes.text(0.5, place, block.verdict + since, va="center", fontsize=9)
    axes.set_yticks(places, blocks)
    axes.invert_yaxis()
    axes.set_xlim(0, 16)
    label(axes, "digits of agreement with differences", "block of x", "1 the program's derivative?")
