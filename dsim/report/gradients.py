"""Section of the report: gradients of whole trajectories, three ways to them, what they cost and how they converge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from dsim import catalog
from dsim.gradients import block_system
from dsim.pictures import gradients as pictures
from dsim.pictures.block_system import spy
from dsim.pictures.style import to_svg
from dsim.report import gradient_cost as costs
from dsim.report.model import Picture, Progress, Section, Table
from dsim.simulation import simulate
from dsim.steppers import BackwardEuler, TwoStepBackwardEuler
from dsim.studies import gradient_cost as cost
from dsim.studies import three_ways as ways
from dsim.studies.cells import Store
from dsim.studies.check import Check
from dsim.studies.gradient_order import order_checks

LEAD = (
    "A trajectory solves one equation `G(x(p), p) = 0`, so `dx/dp = -(dG/dx)^-1 dG/dp`. The whole block system, "
    "forward sensitivities and the adjoint are three ways to the same numbers; the adjoint's cost does not grow with "
    "the number of parameters.\n\n"
    "The adjoint is the exact derivative of the program. Whether that converges to the derivative of the motion "
    "depends on the force: where it is smooth the gradient has the order of the state, at a kink it has order 1 at "
    "most, at a jump it stays wrong for every h."
)


class Part(NamedTuple):
    """What one topic adds to the section."""

    checks: Sequence[Check] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()


def gradients(progress: Progress, full: bool = False) -> Section:
    """All parts, one after the other."""
    parts = [part(progress, full) for part in PARTS]
    return Section(
        LEAD,
        checks=tuple(check for part in parts for check in part.checks),
        tables=tuple(table for part in parts for table in part.tables),
        pictures=tuple(picture for part in parts for picture in part.pictures),
    )


def spy_plots(progress: Progress, full: bool) -> Part:
    """The two matrices of the lecture, for a one-step and a two-step method."""
    progress("dG/dx and dG/dp")
    steps, drawn = 5, []
    words = {
        BackwardEuler(): "A block row a step: the diagonal, and one block below it for the state before.",
        TwoStepBackwardEuler(): "Two blocks below the diagonal: x_n - 2 x_(n-1) + x_(n-2). The past is made up.",
    }
    system, y0 = ways.driven_net(steps)
    for stepper, caption in words.items():
        whole = block_system(simulate(stepper, system, y0, ways.H, steps)).reduced()
        alt = (
            f"Signs of dG/dx, {whole.dGdx.shape[0]} equations of {steps} steps, block lower triangular; and of dG/dp: "
            "full columns for constants of the motion, a block diagonal for the forces of each step."
        )
        drawn.append(Picture(to_svg(spy(whole)), alt, f"{type(stepper).__name__}. {caption}"))
    return Part(pictures=drawn)


def three_ways(progress: Progress, full: bool) -> Part:
    """Monolithic solve, sensitivity and adjoint: every stepper, every kind of parameter."""
    checks: list[Check] = []
    rows = []
    for stepper in catalog.STEPPERS:
        progress(type(stepper).__name__)
        found = ways.three_ways(stepper)
        checks += found
        rows.append((type(stepper).__name__, *(f"{check.measured:.0e}" for check in found)))
    names = [name.removeprefix("springs.").replace("spring_damping.", "damping ") for name in _kinds()]
    caption = "Largest relative difference between the block system, sensitivities and the adjoint"
    return Part(checks, (Table(("stepper", *names), tuple(rows), caption),))


def _kinds() -> tuple[str, ...]:
    return tuple(ways.kinds(ways.driven_net()[0]))


def cost_over_parameters(progress: Progress, full: bool) -> Part:
    """Seconds and errors of the five methods."""
    net, sweep = (cost.Net(points=24), cost.QUICK) if full else (cost.Net(points=12, steps=10), cost.SHORT)
    study = cost.gradient_cost(net, sweep, None, progress)
    alt = "Log-log lines of cost over the number of parameters: four of slope 1, the adjoint flat; and of the errors."
    caption = "Differences cost a run a parameter and half the digits; the adjoint two passes, with all of them."
    picture = Picture(to_svg(pictures.gradient_cost(study)), alt, caption, "dsim accuracy gradients")
    return Part(cost.cost_checks(study), costs.cost_tables(study), (picture,))


def convergence(progress: Progress, full: bool) -> Part:
    """The gradient's error over h beside the state's."""
    studies = costs.orders(not full, Store(), progress)
    alt = "Errors over h: gradient like state on the smooth force, apart at a kink, the gradient flat at a jump."
    caption = "On the fan's edge the true dx(T)/dx(0) is -1; every program that steps across it says +1."
    picture = Picture(to_svg(pictures.gradient_orders(studies)), alt, caption, "dsim accuracy gradients")
    return Part(order_checks(*studies.values()), (costs.order_table(studies),), (picture,))


# In the order of the page.  A topic more (optimisation, checkpoints, verdicts) is one more function here.
PARTS: tuple[Callable[[Progress, bool], Part], ...] = (spy_plots, three_ways, cost_over_parameters, convergence)
