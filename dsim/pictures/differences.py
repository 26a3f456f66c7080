"""The valley of finite differences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dsim.arrays.checks import Array
from dsim.pictures.style import canvas, label, look, style, to_svg


@style()
def valley(steps: Array, errors: Mapping[str, Array]) -> bytes:
    """Relative error of each difference against its step, as SVG."""
    figure, axes = canvas()
    for index, (name, error) in enumerate(errors.items()):
        axes.loglog(steps, np.maximum(error, 1e-17), **look(index), markevery=4, label=name)
    label(axes, "step h (-)", "relative error (-)")
    axes.set_ylim(5e-18, 10)
    axes.legend(loc="center left")
    return to_svg(figure)
