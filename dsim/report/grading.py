"""`dsim grade` on a terminal: a bar, the class in a few lines, and where everything lies."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from dsim.grading import cluster, folder
from dsim.grading import grade as grading
from dsim.grading.results import GRADES, RESULTS, SUMMARY, folder_of
from dsim.grading.sandbox import SandboxError
from dsim.grading.submission import name_of, printable
from dsim.report.terminal import console


def run(
    number: str,
    submissions: Path,
    to: Path,
    where: int | str = 1,
    assignments: Path | None = None,
    sandboxed: bool = True,
) -> int:
    """Grade every submission that has no result yet; the exit status.

    where: so many processes of this machine, or the address of a dask scheduler.
    """
    assignment = folder.find(number, folder.root(assignments))
    found = grading.submissions_in(submissions)
    if to.exists() and not to.is_dir():
        raise ValueError(f"--to must be a directory; {to} is a file")
    if to.resolve() == submissions.resolve():
        raise ValueError(f"--to must not be SUBMISSIONS; grades would lie among what was handed in, in {to}")
    err = console(stderr=True)
    if not sandboxed:
        err.print(Text("Submissions run WITHOUT a sandbox: they can do whatever you can.", style="bold red"))
    if others := _others(submissions, found, to):
        told = ", ".join(others[:8]) + f" and {len(others) - 8} more" * (len(others) > 8)
        err.print(f"not graded, for they are no .py or .ipynb files: {told}", soft_wrap=True, markup=False)
    if younger := [name_of(path) for path in found if _younger(path, to / folder_of(path) / RESULTS)]:
        told = f"changed since they were graded: {', '.join(younger)}; to grade one again, delete its folder in {to}"
        err.print(told, soft_wrap=True, markup=False)
    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    try:
        with (
            cluster.connected(where) if isinstance(where, str) else nullcontext(where) as jobs,
            Progress(*columns, console=err, transient=True) as bar,
        ):
            task = bar.add_task("", total=len(found))

            def say(done: int, total: int, name: str) -> None:
                bar.update(task, completed=done, description=escape(name))

            rows = grading.grade(assignment.path, found, to, jobs, sandboxed, say)
    except SandboxError as error:
        err.print(Text(f"dsim: {error}", style="red"), soft_wrap=True)
        return 2
    out = console()
    out.print((to / SUMMARY).read_text(), markup=False)
    out.print(f"{len(rows)} submission{'s' * (len(rows) != 1)}: {to / GRADES}", soft_wrap=True, markup=False)
    return 0 if len(rows) == len(found) else 2


def _others(submissions: Path, found: Sequence[Path], to: Path) -> list[str]:
    """What lies among the submissions and is none; a student may have meant it."""
    rest = set(submissions.iterdir()) - set(found)
    return sorted(f"{printable(path.name)}{'/' * path.is_dir()}" for path in rest
                  if not path.name.startswith((".", "__")) and path.resolve() != to.resolve())  # fmt: skip


def _younger(submission: Path, result: Path) -> bool:
    return result.is_file() and submission.lstat().st_mtime > result.stat().st_mtime
