"""Hard cases on a terminal, in a directory of pictures, and as a section of the report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table as RichTable
from rich.text import Text

from dsim import catalog
from dsim.pictures.files import write_atomically
from dsim.pictures.hard_cases import side_by_side
from dsim.pictures.style import to_png
from dsim.report import terminal
from dsim.report.model import Picture, Progress, Section, SectionJob, Table
from dsim.studies.hard_cases import HardCase, HardCaseResult

Outcome = tuple[HardCase, HardCaseResult]


def hard_cases(progress: Progress, full: bool = False) -> Section:
    """Every hard case of the catalog: its checks, a table of figures, and its picture."""
    outcomes: list[Outcome] = []
    for case in catalog.HARD_CASES:
        progress(case.title)
        outcomes.append((case, case.run(full=full)))
    checks = [
        replace(check, subject=f"{case.number}, {kind}: {check.subject}")
        for case, result in outcomes
        for kind, found in (("naive", result.naive), ("survivor", result.survivor))
        for check in found
    ]
    lead = (
        "Each case is run twice. The naive method must fail, in the way that theory says: a failure that does not "
        "show is red too. The method that survives must meet its threshold. `dsim hard-cases` runs them alone."
    )
    rows = tuple((case.number, case.title, *result.figures, result.verdict) for case, result in outcomes)
    columns = ("case", "what", "naive", "survivor", "threshold", "verdict")
    pictures = tuple(picture(case, result) for case, result in outcomes)
    return Section(lead, tuple(checks), (Table(columns, rows),), pictures, command="dsim hard-cases")


def picture(case: HardCase, result: HardCaseResult) -> Picture:
    """The two panels of a case, with the words that stand in for them."""
    naive, survivor, threshold = result.figures
    left, right = (panel.title for panel in result.panels)
    alt = f"Two panels. Left, {left}: {naive}. Right, {right}: {survivor}; the threshold is {threshold}."
    caption = f"Case {case.number}, {case.title}: {case.setup}. Truth: {case.truth}."
    return Picture(to_png(side_by_side(case, result), dpi=100), alt, caption, f"dsim hard-cases {case.number}")


def run(cases: Sequence[HardCase], directory: Path | None, full: bool, quiet: bool = False) -> int:
    """Run the cases, print their table, write pictures and JSON if a directory is given; the exit status.

    0: every naive failure was reproduced and every survivor survived.  1: anything else; what failed is listed.
    """
    err = None if quiet else terminal.console(stderr=True)
    outcomes: list[Outcome] = []
    for index, case in enumerate(cases, start=1):
        job = SectionJob(str(case.number), f"case {case.number}: {case.title}", lambda progress: Section(""))
        with terminal.announce(job, f"{index}/{len(cases)}", err):
            outcomes.append((case, case.run(full=full)))
    out = terminal.console()
    out.print(outcome_table(outcomes))
    for case, result in outcomes:
        for check in result.checks:
            if not check.passed:
                found = f"{check.measured:.6g}, must be {check.bound}"
                out.print(
                    Text(f"case {case.number}: {check.subject}: {check.statement}: {found}", style="red"),
                    soft_wrap=True,
                )
    if directory is not None:
        write(outcomes, directory, full)
        out.print(f"{len(outcomes)} pictures and hard_cases.json: {directory}", soft_wrap=True, markup=False)
    return 0 if all(result.ok for _, result in outcomes) else 1


def outcome_table(outcomes: Sequence[Outcome]) -> RichTable:
    """One row a case: how the naive method fails, what the survivor reached, and what it must reach."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    table.add_column("N", justify="right", no_wrap=True)
    for name in ("case", "naive", "survivor", "threshold"):
        table.add_column(name, overflow="fold")
    table.add_column("verdict", no_wrap=True)
    for case, result in outcomes:
        verdict = Text(result.verdict, style="green" if result.ok else "bold red")
        table.add_row(str(case.number), escape(case.title), *map(escape, result.figures), verdict)
    return table


def case_list(cases: Sequence[HardCase]) -> RichTable:
    """The cases with their set-up and truth."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    table.add_column("N", justify="right", no_wrap=True)
    for name in ("case", "set-up", "truth"):
        table.add_column(name, overflow="fold")
    for case in cases:
        table.add_row(str(case.number), escape(case.title), escape(case.setup), escape(case.truth))
    return table


def write(outcomes: Sequence[Outcome], directory: Path, full: bool) -> None:
    """`case_NN.png` for each case, and `hard_cases.json` with checks and curves; each file whole or absent."""
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"--to must be a directory; {directory} is a file")
    for case, result in outcomes:
        write_atomically(directory / f"case_{case.number:02d}.png", to_png(side_by_side(case, result)))
    cases = [
        {"number": case.number, "title": case.title, "setup": case.setup, "truth": case.truth, **result.to_dict()}
        for case, result in outcomes
    ]
    data = {"full": full, "ok": all(result.ok for _, result in outcomes), "cases": cases}
    write_atomically(directory / "hard_cases.json", json.dumps(data, indent=1, allow_nan=False).encode())
