"""Pictures of success for the handouts of the assignments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from dsim import scenes
from dsim.pictures.assignment_02 import springs
from dsim.pictures.assignment_03 import implicit_steps
from dsim.pictures.assignment_04 import tumbling
from dsim.pictures.assignment_06 import quasistatics
from dsim.pictures.assignment_07 import discrete_adjoint
from dsim.pictures.style import COLOURS, canvas, label, style
from dsim.simulation import simulate
from dsim.steppers import ForwardEuler, SymplecticEuler


@style()
def time_stepping() -> Figure:
    """Ten turns of a planet with two Euler methods, from the same start with the same step."""
    planet = scenes.kepler(0.0)
    figure, axes = canvas(1, 2, size=(9.0, 5.2), sharex=True, sharey=True)
    circle = np.linspace(0, 2 * np.pi, 200)
    for panel, stepper, title in zip(axes, (ForwardEuler(), SymplecticEuler()), ("Forward Euler", "Symplectic Euler"),
                                     strict=True):  # fmt: skip
        run = simulate(stepper, planet.system, planet.y0, 0.05, round(20 * np.pi / 0.05))
        panel.plot(np.cos(circle), np.sin(circle), color="#b0b7bf", linewidth=4, label="true orbit")
        panel.plot(run.y[:, 0], run.y[:, 1], color=COLOURS[0], linewidth=1.2, linestyle="-",
                   label="the time of ten turns, h = 0.05")  # fmt: skip
        panel.plot([0], [0], "o", color=COLOURS[5], markersize=9)
        label(panel, "x (m)", "y (m)", title)
        panel.set_aspect("equal")
    axes[1].legend(loc="upper right", fontsize=9)  # where the orbit leaves room
    return figure


SUCCESS: dict[str, Callable[[], Figure]] = {
    "01": time_stepping,
    "02": springs,
    "03": implicit_steps,
    "04": tumbling,
    "06": quasistatics,
    "07": discrete_adjoint,
}
