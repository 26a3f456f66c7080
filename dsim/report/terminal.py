"""The report on a terminal: one table of at most 80 columns per section, progress on stderr."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from dsim.report.model import Page, Progress, Section, SectionJob, figures
from dsim.studies.check import Check

WIDTH = 80
PATIENCE = 2.0  # seconds before a silent computation begins to show its progress
MOST_PASSED = 12  # green rows shown of one section; red rows are always shown


def console(stderr: bool = False) -> Console:
    """A console never wider than 80 columns."""
    found = Console(stderr=stderr, highlight=False)
    found.width = min(WIDTH, found.width)
    return found


def section_table(section: Section) -> Table:
    """The checks of a section, red ones first."""
    verdict = f"{len(section.passed)} passed, {len(section.failed)} failed, {section.seconds:.1f} s"
    table = Table(title=f"{escape(section.title)}  ({verdict})", title_justify="left", title_style="bold", expand=False)
    table.add_column("", width=4, no_wrap=True)
    table.add_column("subject", ratio=3, overflow="fold")
    table.add_column("statement", ratio=5, overflow="fold")
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("bound", max_width=16, overflow="fold")
    for check in (*section.failed, *section.passed[:MOST_PASSED]):
        table.add_row(_verdict(check), *map(escape, _words(check)))
    hidden = len(section.passed) - MOST_PASSED
    if hidden > 0:
        table.caption, table.caption_justify = f"... and {hidden} more passed", "left"
    return table


def print_section(section: Section, out: Console) -> None:
    """Print the table of one section; the numbers of its other tables are on the page."""
    out.print(section_table(section))
    if section.details:
        out.print(Text(section.details.rstrip().splitlines()[-1], style="red"))
    out.print()


def summary(page: Page, place: str) -> str:
    """The closing line: verdict, seconds and where the page is."""
    limit = f" of {page.limit:g} s" if page.limit is not None else ""
    return f"{page.passed} passed, {page.failed} failed in {page.seconds:.1f} s{limit}: {place}"


@contextmanager
def announce(job: SectionJob, position: str, err: Console | None) -> Iterator[Progress]:
    """Show that `job` runs: a spinner on a terminal, a plain line in a log, nothing if `err` is None."""
    if err is None:
        yield lambda text: None
        return
    title = f"[{position}] {job.title}"
    if not err.is_terminal:
        err.print(escape(title))
        yield lambda text: None
        return
    with err.status(escape(title)) as status:
        yield lambda text: status.update(escape(f"{title}: {text}"))


def _verdict(check: Check) -> Text:
    return Text("pass", style="green") if check.passed else Text("FAIL", style="bold red")


def _words(check: Check) -> tuple[str, str, str, str]:
    return check.subject, check.statement, figures(check.measured), check.bound


@contextmanager
def waiting(err: Console, what: str) -> Iterator[None]:
    """A spinner on stderr; a terminal alone shows it."""
    with err.status(what):
        yield


@contextmanager
def counting(f: Callable[[Any], Any], what: str) -> Iterator[Callable[[Any], Any]]:
    """f, with a count of its calls on stderr once they have taken two seconds."""
    start, count, err = time.perf_counter(), 0, console(stderr=True)
    with err.status("") as status:
        status.stop()

        def seen(calls: int) -> None:
            nonlocal count
            count += calls
            if time.perf_counter() - start > PATIENCE:
                status.start()
                status.update(f"{count} {what}")

        yield _Counted(f, seen)


class _Counted:
    def __init__(self, f: Callable[[Any], Any], seen: Callable[[int], None]) -> None:
        self._f, self._seen = f, seen
        if hasattr(f, "many"):
            self.many = self._many

    def __call__(self, x: Any) -> Any:
        self._seen(1)
        return self._f(x)

    def _many(self, points: list[Any]) -> Any:
        self._seen(len(points))
        return cast(Any, self._f).many(points)
