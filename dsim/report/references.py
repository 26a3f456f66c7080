"""`dsim references`: reference problems listed, exported and checked on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table as RichTable
from rich.text import Text

from dsim.report.terminal import console
from dsim.studies.answers import export as exporting
from dsim.studies.answers.document import Item


def listing(items: Sequence[Item]) -> None:
    """Print a row a problem."""
    table = RichTable(expand=False, padding=(0, 1), box=None, header_style="bold")
    for name, side in (("NAME", "left"), ("unknowns", "right"), ("parameters", "right"), ("length", "left")):
        table.add_column(name, justify=side, no_wrap=True)  # type: ignore[arg-type]
    table.add_column("certified by", overflow="fold")
    for item in items:
        table.add_row(escape(item.name), str(item.unknowns), str(item.parameters), item.duration, escape(item.source))
    console().print(table)


def export(items: Sequence[Item], directory: Path, names: Iterable[str], quiet: bool = False) -> int:
    """Write the problems of these names; 1 where a certificate is not met."""
    chosen = exporting.select(items, names)
    try:
        with _counting(len(chosen), quiet) as say:
            written = exporting.export(chosen, directory, say)
    except ArithmeticError as error:
        console(stderr=True).print(Text(f"dsim: nothing was written: {error}", style="red"), soft_wrap=True)
        return 1
    console().print(f"{len(chosen)} problems: {written}", soft_wrap=True, markup=False)
    return 0


def check(items: Sequence[Item], directory: Path, quiet: bool = False) -> int:
    """Check an export and print what differs."""
    with _counting(exporting.size(directory), quiet) as say:
        checks = exporting.check(items, directory, say)
    red = [found for found in checks if not found.passed]
    out = console()
    for found in red:
        out.print(Text(str(found), style="red"), soft_wrap=True)
    out.print(f"{len(checks) - len(red)} passed, {len(red)} failed: {directory}", soft_wrap=True, markup=False)
    return 1 if red or not checks else 0


@contextmanager
def _counting(total: int, quiet: bool) -> Iterator[exporting.Say]:
    """A bar on stderr with the name of the problem in hand."""
    if quiet:
        yield lambda text: None
        return
    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task, seen = bar.add_task("", total=total), 0

        def say(text: str) -> None:
            nonlocal seen
            bar.update(task, completed=seen, description=escape(text))
            seen += 1

        yield say
