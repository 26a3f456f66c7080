"""Showcases on a terminal, as pictures in a directory, and as a section of the report."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table as RichTable

from dsim import catalog
from dsim.pictures.showcases import convergence
from dsim.pictures.style import save, to_png
from dsim.report import terminal
from dsim.report.model import Picture, Progress, Section
from dsim.studies.showcases.model import Showcase, Success


def listing() -> RichTable:
    """The showcases with their statements."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    table.add_column("NAME", no_wrap=True)
    table.add_column("what", overflow="fold")
    for row in catalog.SHOWCASES:
        table.add_row(escape(row.name), escape(row.statement))
    return table


def run(row: Showcase, to: Path | None, full: bool, quiet: bool = False) -> int:
    """Run one showcase, print its checks, write its pictures if a directory is given; the exit status.

    0: every check passed.  1: one did not.
    """
    if to is not None and to.exists() and not to.is_dir():
        raise ValueError(f"--to must be a directory; {to} is a file")
    start = time.perf_counter()
    columns = (BarColumn(18), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Bar(*columns, console=terminal.console(stderr=True), transient=True, disable=quiet) as bar:
        task = bar.add_task(row.name, total=None)
        result: Success = row.run(not full, partial(_show, bar, task))
    checks, seconds = result.checks(), time.perf_counter() - start
    out = terminal.console()
    out.print(terminal.section_table(Section("", checks, title=f"{row.name}: {row.statement}", seconds=seconds)))
    found = result.optimisation
    out.print(str(found), markup=False)
    if to is not None:
        save(row.draw(result), to / f"{row.name}.png")
        save(convergence(found, row.name), to / f"{row.name}_convergence.svg")
        out.print(f"{row.name}.png, {row.name}_convergence.svg: {to}", soft_wrap=True, markup=False)
    return 0 if all(check.passed for check in checks) else 1


def _show(bar: Bar, task: Any, done: int, total: int, text: str) -> None:
    bar.update(task, completed=done, total=total, description=escape(text))


def showcases(progress: Progress, full: bool = False) -> Section:
    """Every showcase of the catalog: its checks and its pictures."""
    results: list[tuple[Showcase, Success]] = []
    for row in catalog.SHOWCASES:
        progress(row.name)
        results.append((row, row.run(not full, lambda done, total, text: progress(text))))
    checks = [check for _, result in results for check in result.checks()]
    lead = (
        "Gradients put to work, each with its success measured and its start shown: an optimiser that does nothing is "
        "red. `dsim optimise` runs them alone."
    )
    pictures = tuple(picture for row, result in results for picture in _pictures(row, result))
    return Section(lead, tuple(checks), pictures=pictures, command="dsim optimise")


def _pictures(row: Showcase, result: Success) -> tuple[Picture, Picture]:
    found = result.optimisation
    gain = f"the objective falls from {found.values[0]:.3g} to {found.value:.3g} in {found.evaluations} evaluations"
    command = f"dsim optimise {row.name} --to pictures"
    return (
        Picture(to_png(row.draw(result), dpi=90), f"{row.name}, before and after: {gain}.", row.statement, command),
        Picture(to_png(convergence(found, row.name), dpi=80), f"{row.name}: {gain}.", "Convergence.", command),
    )
