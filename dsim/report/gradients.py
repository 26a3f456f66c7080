"""Section of the report: gradients of whole trajectories, three ways to them, and how they converge; what they cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from dsim import catalog
from dsim.gradients import adjoint, block_system
from dsim.pictures import gradients as pictures
from dsim.pictures.audit import verdicts as draw_verdicts
from dsim.pictures.block_system import spy
from dsim.pictures.checkpoints import schedule as draw_checkpoints
from dsim.pictures.style import to_svg
from dsim.report import auditing
from dsim.report import gradient_cost as costs
from dsim.report.model import Picture, Progress, Section, Table
from dsim.simulation import simulate
from dsim.steppers import BackwardEuler, SymplecticEuler, TwoStepBackwardEuler
from dsim.steppers.checkpoints import Checkpoints
from dsim.studies import audit, horizons
from dsim.studies import gradient_cost as cost
from dsim.studies import three_ways as ways
from dsim.studies.cells import Store
from dsim.studies.check import Check
from dsim.studies.gradient_order import order_checks
from dsim.studies.hard_cases.model import equal
from dsim.studies.peers import cloth_problem, cloth_truth, twin
from dsim.studies.verdicts.physics import REFINEMENTS

LEAD = (
    "A trajectory solves one equation `G(x(p), p) = 0`, so `dx/dp = -(dG/dx)^-1 dG/dp`. The whole block system, "
    "forward sensitivities and the adjoint are three ways to the same numbers.\n\n"
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


def gradient_cost(progress: Progress, full: bool = False) -> Section:
    """A section of its own, because it measures seconds: costs and errors of the five methods."""
    net, sweep = (cost.Net(points=24), cost.QUICK) if full else (cost.Net(points=12, steps=10), cost.SHORT)
    study = cost.gradient_cost(net, sweep, None, progress)
    alt = "Log-log lines of cost over the number of parameters: four of slope 1, the adjoint flat; and of the errors."
    caption = "Differences cost a run a parameter and half the digits; the adjoint two passes, with all of them."
    picture = Picture(to_svg(pictures.gradient_cost(study)), alt, caption, "dsim accuracy gradients")
    lead = (
        "One gradient by five methods, over the number of parameters. Four of them pay for every parameter; the "
        "adjoint goes once forward and once back, however many there are."
    )
    return Section(lead, tuple(cost.cost_checks(study)), costs.cost_tables(study), (picture,))


def convergence(progress: Progress, full: bool) -> Part:
    """The gradient's error over h beside the state's."""
    studies = costs.orders(not full, Store(), progress)
    alt = "Errors over h: gradient like state on the smooth force, apart at a kink, the gradient flat at a jump."
    caption = "On the fan's edge the true dx(T)/dx(0) is -1; every program that steps across it says +1."
    picture = Picture(to_svg(pictures.gradient_orders(studies)), alt, caption, "dsim accuracy gradients")
    return Part(order_checks(*studies.values()), (costs.order_table(studies),), (picture,))


def checkpoints(progress: Progress, full: bool) -> Part:
    """The staircase, and what a gradient with few states kept costs: foretold and counted."""
    progress("checkpoints")
    system, y0 = ways.driven_net(48)
    checks, rows = [], []
    for snapshots in (1, 4, 10):
        ahead = Checkpoints(snapshots)
        run = simulate(SymplecticEuler(), system, y0, ways.H, 48, keep=ahead)
        took = 48 + adjoint(run, run.last).recomputed
        checks.append(equal(f"{snapshots} states kept", "steps taken beyond those foretold",
                            took - ahead.advances(48), 0))  # fmt: skip
        rows.append((snapshots, ahead.advances(48), took, ahead.most(48)))
    alt = "A staircase: steps run forward, are pulled back, and stretches between kept states are run again."
    caption = "Binomial checkpoints: with 10 states, 1001 steps take 3641 and none is taken more than 4 times."
    picture = Picture(to_svg(draw_checkpoints()), alt, caption, "dsim verify --only gradients")
    columns = ("states kept", "steps foretold", "steps taken", "at most, a step")
    table = Table(columns, tuple(rows), "48 steps and their gradient with few states kept")
    return Part(checks, (table,), (picture,))


def verdicts(progress: Progress, full: bool) -> Part:
    """dsim's cloth, a chaotic map and a ball over a wall under the three verdicts; planted bugs; a picture."""
    problem = cloth_problem(n=3, steps=10)
    cases = (
        (twin(problem), cloth_truth(problem, 500), 0.01, ("right", "converges", "downhill")),
        (horizons.logistic(4), None, 1e-4, ("right", "not asked", "downhill")),
        (horizons.logistic(60), None, 1e-4, (None, "not asked", "chaotic")),
        (horizons.over_the_wall(), None, 0.14, ("right", "not asked", "biased")),
    )
    reports, checks = [], []
    for simulator, truth, sigma, words in cases:
        progress(f"verdicts: {simulator.name}")
        found = audit(simulator, truth, refinements=REFINEMENTS if truth else (), sigma=sigma)
        reports.append(found)
        for name, word, expected in zip(("program", "physics", "descent"), found.words, words, strict=True):
            if expected is not None:
                checks.append(equal(simulator.name, f'{name}: the verdict is "{expected}"', word == expected, 1))
    few = [bug for bug in catalog.PLANTED if full or bug.name in ("counted twice", "guarded division")]
    bugs = auditing.planted(few, progress)
    checks += [equal(bug.name, "found in the blocks and from the steps foretold", auditing.caught(bug, verdict), 1)
               for bug, verdict in bugs]  # fmt: skip
    alt = "Bars: digits of every block. Lines: gradient error over h; growth over time, doubling each step in chaos."
    caption = "Three verdicts. A map that doubles errors every step has no digit left after 50."
    picture = Picture(to_svg(draw_verdicts([*reports[:1], *reports[2:]])), alt, caption, "dsim verify --only gradients")
    tables = (auditing.verdict_table([auditing.Audited(r.name, r) for r in reports]), auditing.bug_table(bugs))
    return Part(checks, tables, (picture,))


# In the order of the page.  A topic more (optimisation, checkpoints, verdicts) is one more function here.
PARTS: tuple[Callable[[Progress, bool], Part], ...] = (
    spy_plots,
    three_ways,
    convergence,
    checkpoints,
    verdicts,
)
