"""The picture of success of assignment 03."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsim.effects import Springs
from dsim.pictures.style import canvas, label, look, style
from dsim.simulation import record
from dsim.solve.newton import newton
from dsim.steppers import BackwardEuler, ForwardEuler
from dsim.system import System


@style()
def implicit_steps() -> Figure:
    """Newton's residuals for a root, and a stiff spring with two methods."""
    figure, axes = canvas(1, 2, size=(9.0, 4.0))
    for i, factor in enumerate((1.0, 1.03)):
        found = newton(lambda z: z**3 - 7, lambda z, f=factor: f * np.diag(3 * z**2), np.array([4.0]))  # type: ignore[misc]
        name = "the derivative" if i == 0 else "3 % off"
        axes[0].semilogy(np.maximum(found.residuals, 1e-16), **look(i), label=name)
    label(axes[0], "iteration", "residual", "Newton for the root of z^3 = 7")
    axes[0].legend()
    spring = System([1.0, 1.0], [Springs([(0, 1)], 0.0, 400.0)], dimension=1, fixed=[0])
    for i, stepper in enumerate((BackwardEuler(), ForwardEuler())):
        run = record(stepper, spring, [0.0, 1.0, 0.0, 0.0], 0.02, 60)
        axes[1].plot(run.t, run.q[:, 1], **{**look(i), "marker": ""}, label=type(stepper).__name__)
    axes[1].set_ylim(-8.5, 4.5)
    label(axes[1], "time (s)", "position (m)", "A spring with h w = 0.4")
    axes[1].legend(loc="lower left")  # before the blow-up
    return figure
