"""`dsim audit`: three verdicts on one program or several, and the planted bugs found."""

from __future__ import annotations

import inspect
import json
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from sys import stderr
from typing import Any

from rich.markup import escape
from rich.table import Table as RichTable

from dsim.report.model import Cell, Table
from dsim.report.terminal import console
from dsim.studies.foreign import load_function, told
from dsim.studies.peers import (
    PEERS,
    Agreement,
    Problem,
    agreement,
    cloth_problem,
    cloth_truth,
    load,
    of_program,
    twin,
)
from dsim.studies.planted import PlantedBug
from dsim.studies.verdicts import AuditReport, ProgramVerdict, Simulator, audit, judge_program

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Audited:
    """A program with its verdicts, and how far it is from dsim where both are the same program; or why it was left."""

    name: str
    report: AuditReport | None = None
    agreement: Agreement | None = None
    skipped: str = ""

    @property
    def code(self) -> int:
        if self.report is None:
            return 2
        return 1 if self.agreement is not None and not self.agreement.ok else self.report.code

    def to_dict(self) -> dict[str, Any]:
        if self.report is None:
            return {"name": self.name, "skipped": self.skipped}
        near = self.agreement
        same = None if near is None else {"state": near.state, "gradient": near.gradient, "allowed": near.allowed}
        return self.report.to_dict() | {"agreement": same}


def given(text: str, problem: Problem) -> Simulator:
    """FILE.py:FUNCTION.  A function of the cloth's arrays makes a program of them; one of nothing makes a Simulator."""
    function = load_function(text)
    cloth = bool(inspect.signature(function).parameters)
    simulator = of_program(text, function, problem) if cloth else function()
    if not isinstance(simulator, Simulator):
        raise ValueError(f"{text} must return a Simulator (dsim.studies.verdicts); got {simulator!r:.60}")
    path = Path(text.rpartition(":")[0]).resolve()  # its callables are the user's too: one line and no print among JSON
    return replace(
        simulator,
        simulate=told(simulator.simulate, "forward" if cloth else "simulate", path),
        gradient=told(simulator.gradient, "gradient", path),
    )


def one(text: str, say: Say) -> Audited:
    """dsim's own cloth (no text), or a program of the user's; a program of the cloth is held against dsim's too."""
    problem = cloth_problem()
    same, truth = twin(problem), cloth_truth(problem)
    simulator = given(text, problem) if text else same
    if simulator.blocks.keys() != same.blocks.keys() or simulator.x.shape != same.x.shape:
        return Audited(simulator.name, audit(simulator, report=say))
    near = agreement(simulator, same) if text else None
    return Audited(simulator.name, audit(simulator, truth, report=say), near)


def peers(directory: Path, say: Say) -> list[Audited]:
    """Each of the other simulators, where its package is installed."""
    problem = cloth_problem()
    same, truth = twin(problem), cloth_truth(problem)
    found = []
    for peer in PEERS:
        if not peer.installed:
            found.append(Audited(peer.name, skipped=f"the package {peer.package} is not installed"))
            continue
        say(peer.name)
        with redirect_stdout(stderr):
            simulator = of_program(peer.name, load(directory / peer.file), problem)
            near = agreement(simulator, same)
            found.append(Audited(peer.name, audit(simulator, truth, report=_after(peer.name, say)), near))
    return found


def _after(name: str, say: Say) -> Say:
    return lambda verdict: say(f"{name}: {verdict}")


def planted(bugs: Iterable[PlantedBug], say: Say) -> list[tuple[PlantedBug, ProgramVerdict]]:
    """The first verdict on every planted bug."""
    found = []
    for bug in bugs:
        say(bug.name)
        found.append((bug, judge_program(bug.make())))
    return found


def caught(bug: PlantedBug, verdict: ProgramVerdict) -> bool:
    """Whether the verdict names exactly the blocks that are wrong, with the steps from which they are."""
    return {block.block: block.first_bad_step for block in verdict.wrong} == dict(bug.wrong)


# On the terminal


def verdict_lines(audited: Sequence[Audited]) -> str:
    """Every program with its three verdicts, in 80 columns."""
    lines = []
    for each in audited:
        lines.append(f"{each.name}: skipped, {each.skipped}" if each.report is None else each.name)
        if each.report is not None:
            verdicts = {"program's": each.report.program, "physics'": each.report.physics,
                        "descent": each.report.descent}  # fmt: skip
            lines += [textwrap.fill(f"  {label:10s} {verdict}", 80, subsequent_indent=" " * 13)
                      for label, verdict in verdicts.items()]  # fmt: skip
        if each.agreement is not None:
            near = each.agreement
            lines.append(f"  {'as dsim':10s} states to {near.state:.0e}, gradient to {near.gradient:.0e}, "
                         f"must be {near.allowed:.0e}")  # fmt: skip
    if any(each.skipped for each in audited):
        lines.append('python -m pip install -e ".[peers]" installs what is skipped.')
    return "\n".join(lines)


def verdict_table(audited: Sequence[Audited]) -> Table:
    """The same for the report: a row a program."""
    rows: list[tuple[Cell, ...]] = []
    for each in audited:
        if each.report is not None:
            report = each.report
            rows.append((each.name, str(report.program), str(report.physics), str(report.descent)))
    columns = ("program", "the program's derivative?", "the physics'?", "downhill?")
    return Table(columns, tuple(rows), "Three verdicts", "dsim audit")


def bug_table(found: Sequence[tuple[PlantedBug, ProgramVerdict]], families: bool = True) -> Table:
    """A row a planted bug: what shipped, the copy planted here, and where it shows first."""
    rows: list[tuple[Cell, ...]] = []
    for bug, verdict in found:
        first = verdict.wrong[0] if verdict.wrong else None
        place = "nowhere" if first is None else f"{first.block}, step {first.first_bad_step}"
        blocks = f"{len(verdict.wrong)} of {len(verdict.blocks)}"
        rows.append((*[bug.family] * families, bug.name, verdict.verdict, place, blocks,
                     "yes" if caught(bug, verdict) else "NO"))  # fmt: skip
    columns = (*["bug that shipped"] * families, "planted here", "verdict", "first seen in", "blocks", "as foretold")
    caption = "Planted bugs; which blocks go wrong, and from which step on, follows from the formulas"
    return Table(columns, tuple(rows), caption, "dsim audit --planted")


def run(text: str, directory: Path | None, as_json: bool, plot: Path | None, quiet: bool = False) -> int:
    """Audit one program (text; dsim's own without), or the other simulators in `directory`; the exit status."""
    with _saying(quiet or as_json) as say:
        audited = [one(text, say)] if directory is None else peers(directory, say)
    if plot is not None:
        from dsim.pictures.audit import verdicts
        from dsim.pictures.style import save

        save(verdicts([each.report for each in audited if each.report is not None]), plot)
    if as_json:
        data = [each.to_dict() for each in audited]
        print(json.dumps(data if directory is not None else data[0], indent=2, allow_nan=False))
    else:
        print(verdict_lines(audited))
    judged = [each.code for each in audited if each.report is not None]
    if not judged:
        return 2
    return 1 if 1 in judged else max(judged)


def run_planted(bugs: Iterable[PlantedBug], quiet: bool = False) -> int:
    """Judge every planted bug and print the table; 0 if each was found as it must be, 1 if not."""
    with _saying(quiet) as say:
        found = planted(bugs, say)
    console().print(_rich(bug_table(found, families=False)))
    return 0 if all(caught(bug, verdict) for bug, verdict in found) else 1


@contextmanager
def _saying(quiet: bool) -> Iterator[Say]:
    """A spinner on stderr with what is being judged; a plain line each in a log."""
    err = console(stderr=True)
    if quiet or not err.is_terminal:
        yield lambda text: None if quiet else err.print(text, markup=False)
        return
    with err.status("") as status:
        yield lambda text: status.update(escape(text))


def _rich(table: Table) -> RichTable:
    found = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold", title=table.caption)
    found.title_justify = "left"
    for column in table.columns:
        found.add_column(column, overflow="fold")
    for row in table.rows:
        found.add_row(*(escape(str(cell)) for cell in row))
    return found
