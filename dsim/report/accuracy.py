"""What accuracy costs: the command `dsim accuracy`, and its section of the report."""

from __future__ import annotations

import difflib
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table as Lines

from dsim import catalog
from dsim.arrays.checks import Array
from dsim.pictures import work_precision as pictures
from dsim.pictures.files import write_atomically
from dsim.pictures.style import save, to_svg
from dsim.report import gradient_cost, model, terminal
from dsim.report.model import Picture, Section, Table, figures
from dsim.steppers import BackwardEuler, ImplicitMidpoint
from dsim.studies import problems, tolerances
from dsim.studies.cells import Store, versions
from dsim.studies.check import Check
from dsim.studies.work_precision import (
    COUNTED,
    QUANTITIES,
    QUICK,
    TARGETS,
    Method,
    Study,
    Sweep,
    finite,
    work_precision,
)

CURVES = "newton-tolerance.png", "difference-steps.png"  # that belong to no problem
ASYMPTOTIC = 0.999  # R^2 of a fit that deserves to be called an order
QUICK_PROBLEMS = ("projectile", "pendulum")  # the others when they are named
GRADIENTS = "gradients"  # beside the problems: what gradients cost, and how they converge


def methods(problem: problems.Problem) -> tuple[Method, ...]:
    """All steppers that can take the problem's steps, and its references."""
    steppers = catalog.BODY_STEPPERS if problem.system.curved else catalog.STEPPERS
    return (*steppers, *problem.references)


def select(names: Sequence[str]) -> tuple[problems.Problem, ...]:
    """The problems of these names, all of them without any; ValueError with suggestions for a name nobody knows."""
    found = {build.__name__.replace("_", "-"): build for build in catalog.PROBLEMS}
    known = [*found, GRADIENTS]
    for name in names:
        if name not in found:
            close = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise ValueError(f"PROBLEM must be one of {', '.join(known)}; got {name!r}{hint}")
    return tuple(build() for name, build in found.items() if not names or name in names)


def run(names: Sequence[str], to: Path, *, quick: bool = False, fresh: bool = False) -> int:
    """Measure, draw, print and write everything under `to`; finished cells are read from `to/cells`.

    names: problems, and "gradients"; no name means every problem (with quick: two).  Returns the exit code: 1 where a
    check of the gradients is red.
    """
    if to.exists() and not to.is_dir():
        raise ValueError(f"--to must be a directory; {to} is a file")
    wanted = [name for name in names if name != GRADIENTS]
    chosen = select(wanted or QUICK_PROBLEMS * quick) if wanted or not names else ()
    sweep, store = QUICK if quick else Sweep(), Store(to / "cells", fresh=fresh)
    studies, results = [], None
    with _bar() as bar:
        task = bar.add_task("", total=sum(_cells(p, sweep) for p in chosen))
        for problem in chosen:
            show = partial(_show, bar, task)
            study = work_precision(problem, methods(problem), sweep, store, show)
            studies.append(study)
            bar.update(task, completed=sum(len(study.cells) for study in studies))
            for kind in ("png", "svg"):
                save(pictures.work_precision(study), to / f"{study.problem}.{kind}")
        if chosen:
            bar.update(task, description="Newton's tolerance, difference steps")
            _curves(to, 50 if quick else 200, fresh)
        if GRADIENTS in names:
            bar.update(task, total=None)  # how much is left depends on what it costs
            results = gradient_cost.measure(quick, store, partial(_show, bar, task))
            gradient_cost.draw(results, to)
    out = terminal.console()
    with out.capture() as text:
        for table in (*(t for study in studies for t in tables(study)), *(results.tables() if results else ())):
            out.print(lines(table))
    write_atomically(to / "table.txt", text.get().encode())
    data = {"versions": versions(), "studies": [study.to_dict() for study in studies]}
    data |= {GRADIENTS: results.to_dict()} if results else {}
    write_atomically(to / "accuracy.json", json.dumps(finite(data), indent=1, allow_nan=False).encode())
    out.print(text.get(), markup=False, end="")
    drawn = [f"{study.problem}.png" for study in studies] + (list(CURVES) if chosen else [])
    drawn += [f"{name}.png" for name in gradient_cost.PICTURES] if results else []
    out.print(f"{', '.join(drawn)}, table.txt, accuracy.json: {to}", soft_wrap=True, markup=False)
    return int(results is not None and not all(check.passed for check in results.checks))


def _bar() -> Progress:
    columns = (BarColumn(18), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    return Progress(*columns, console=terminal.console(stderr=True), transient=True)


def _show(bar: Progress, task: TaskID, text: str) -> None:
    bar.update(task, description=text, advance=0 if "timing" in text else 1)


def _cells(problem: problems.Problem, sweep: Sweep) -> int:
    return sum(len(sweep.settings(problem, method)) for method in methods(problem))


def _curves(to: Path, steps: int, fresh: bool) -> None:
    """The two curves that belong to no problem; drawn once in a directory."""
    if not fresh and all((to / name).exists() for name in CURVES):
        return
    tolerance, differences = CURVES
    save(pictures.newton_tolerance(newton_curves(steps)), to / tolerance)
    widths = tolerances.DIFFERENCE_STEPS
    save(pictures.difference_steps(widths, tolerances.difference_steps(widths)), to / differences)


def newton_curves(steps: int = 200) -> dict[str, tuple[Array, Array, Array]]:
    """Newton's tolerance against the error, for two methods on the pendulum."""
    pendulum = problems.pendulum()
    return {
        type(s).__name__: tolerances.newton_tolerance(pendulum, s, steps) for s in (BackwardEuler(), ImplicitMidpoint())
    }


# Tables


def tables(study: Study) -> tuple[Table, Table]:
    """Methods with their best figures; and the cheapest method for every error."""
    rows: list[tuple[model.Cell, ...]] = []
    for method in study.methods:
        cells = study.of(method)
        finest = cells[-1]
        fit = study.order(method)
        order = f"{fit.order:.2f} +- {fit.standard_error:.2f}" if fit else "-"
        if fit and fit.r_squared < ASYMPTOTIC:
            order = f"({fit.order:.1f})"
        failures = sum(cell.failed for cell in cells)
        best = [min(cell.error_of(quantity) for cell in cells) for quantity in QUANTITIES]
        cost = _known(finest.seconds, ".2g") if study.unit == "seconds" else str(finest.counts["forces"])
        rows.append((method, order, *(f"{e:.0e}" for e in best), _known(finest.drift, ".0e"), cost, failures))
    unit = "s" if study.unit == "seconds" else "forces"
    columns = ("method", "order", "state", "gradient", "drift", unit, "failed")
    band = (
        f"; a run timed against itself: {study.band[0]:.2f} to {study.band[1]:.2f}" if study.unit == "seconds" else ""
    )
    words = (
        f"smallest errors; drift and cost at the finest setting; (order): R^2 < {ASYMPTOTIC}, no power law yet; "
        "-: too few points, or adaptive"
    )
    first = Table(columns, tuple(rows), f"{study.problem}: {words}{band}")
    answers = []
    for target in TARGETS:
        row: list[model.Cell] = [f"{target:.0e}"]
        for quantity in QUANTITIES:
            answer = study.cheapest(target, quantity)
            row += [str(answer), f"{answer.cost:.2g}" if answer.reached else ""]
        answers.append(tuple(row))
    caption = f"{study.problem}: cheapest method for an error (=: not told apart by the control)"
    return first, Table(("error", "state", unit, "gradient", unit), tuple(answers), caption)


def _known(value: float, form: str) -> str:
    """The number, or nothing: a problem without invariants has no drift, a failed run no seconds."""
    return "" if value != value else format(value, form)


def lines(table: Table) -> Lines:
    """A table for the terminal."""
    found = Lines(title=escape(table.caption), title_justify="left", title_style="bold")
    for column in table.columns:
        found.add_column(escape(column), overflow="fold")
    for row in table.rows:
        found.add_row(*(escape(figures(cell)) for cell in row))
    return found


# The section of `dsim verify`


def accuracy(progress: model.Progress, full: bool = False) -> Section:
    """Errors over force evaluations on the pendulum; with `full`, every problem, timed."""
    chosen = select(()) if full else (problems.pendulum(),)
    checks: list[Check] = []
    found: list[Table] = []
    drawn: list[Picture] = []
    for problem in chosen:
        study = work_precision(problem, methods(problem), QUICK if full else COUNTED, None, progress)
        found += tables(study)
        checks += study_checks(study)
        alt = f"Error of state and gradient over {study.unit} for {len(study.methods)} methods on {study.problem}."
        caption = f"{study.problem}: down and left is better; crosses at the top edge are runs that failed."
        command = f"dsim accuracy {study.problem}"
        drawn.append(Picture(to_svg(pictures.work_precision(study)), alt, caption, command))
    progress("finite differences")
    steps = tolerances.DIFFERENCE_STEPS
    errors = tolerances.difference_steps(steps)
    for name, bound in (("forward", 1e-7), ("central", 1e-9), ("complex", 1e-15)):
        least = float(errors[name].min())
        checks.append(Check("differences", f"best {name} difference", least <= bound, least, f"<= {bound:.0e}"))
    alt = "Errors of forward, central and complex differences over the step: two Vs and a line that stays at 1e-16."
    drawn.append(Picture(to_svg(pictures.difference_steps(steps, errors)), alt, "Finite differences: the V."))
    lead = (
        "The error of every method against a known motion, over what the run cost, and the error of the adjoint's "
        "gradient against the gradient of the true motion. `dsim accuracy` measures seconds, on all problems."
    )
    return Section(lead, tuple(checks), tuple(found), tuple(drawn))


def study_checks(study: Study) -> list[Check]:
    """The truth is known a hundred times better than what is shown; states and gradients converge."""
    known = max(study.certificate, study.gradient_certificate)
    checks = [Check(study.problem, "two references agree", known <= 1e-8, known, "<= 1e-8")]
    for quantity in QUANTITIES:
        least = min(cell.error_of(quantity) for cell in study.cells if cell.steps)
        checks.append(Check(study.problem, f"smallest error of the {quantity}", least <= 1e-2, least, "<= 1e-2"))
    if study.problem == "pendulum":
        declared = {type(s).__name__: s.order for s in catalog.STEPPERS}
        for method in ("SymplecticEuler", "ImplicitMidpoint", "VelocityVerlet", "RK4"):
            for quantity in QUANTITIES:
                fit, p = study.order(method, quantity), declared[method]
                order = fit.order if fit else float("nan")
                checks.append(Check(method, f"order of the {quantity}", abs(order - p) <= 0.35, order, f"{p} +- 0.35"))
    return checks
