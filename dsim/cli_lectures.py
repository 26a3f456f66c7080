"""`dsim lectures`.  Each command imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

lectures = typer.Typer(
    help="The lectures: list them, open them in Jupyter, run them, make the site.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)

Where = Annotated[Path | None, typer.Option("--lectures", help="Where the lectures lie, if not here.", metavar="DIR")]
Numbers = Annotated[list[str] | None, typer.Argument(help="All by default.", metavar="[NN]...")]
Jobs = Annotated[int, typer.Option("--jobs", help="So many at a time.", min=1)]


@lectures.command(name="list")
def list_all(where: Where = None) -> None:
    """Numbers and titles."""
    from dsim.report import lectures as report

    report.listing(where)


@lectures.command(name="open")
def open_all(
    number: Annotated[str, typer.Argument(help="A lecture; the folder if none.", metavar="[NN]")] = "",
    where: Where = None,
) -> None:
    """Start Jupyter on the notebooks.  Exit code 2: Jupyter is not installed; the extra `lectures` of dsim brings it.

    **Examples**

    `dsim lectures open 01` - the first lecture
    """
    from dsim.report import lectures as report

    raise typer.Exit(report.open_all(number, where))


@lectures.command()
def build(
    numbers: Numbers = None,
    html: Annotated[bool, typer.Option("--html", help="The site as well.")] = False,
    to: Annotated[
        Path | None, typer.Option("--to", help="Where the site goes; without --html, the notebooks.", metavar="DIR")
    ] = None,
    student: Annotated[bool, typer.Option("--student", help="Without the solutions of the exercises.")] = False,
    jobs: Jobs = 2,
    where: Where = None,
) -> None:
    """Run the lectures and write them as notebooks with outputs, beside their sources.

    Exit code 0: written. 1: a cell failed; its lecture is not written. 2: bad usage.

    **Examples**

    `dsim lectures build` - every notebook

    `dsim lectures build --html --to site` - and the pages: open `site/index.html`, no network needed

    `dsim lectures build 01 --student --to handouts` - one lecture without its solutions
    """
    from dsim.report import lectures as report

    raise typer.Exit(report.build(numbers or (), where, to, html, student, jobs))


@lectures.command()
def check(numbers: Numbers = None, jobs: Jobs = 2, where: Where = None) -> None:
    """Run the lectures; are the asserts in their cells true, and are the notebooks those of the sources?

    Exit code 0: yes. 1: no; what is wrong is listed. 2: bad usage.

    **Examples**

    `dsim lectures check 01 02`
    """
    from dsim.report import lectures as report

    raise typer.Exit(report.check(numbers or (), where, jobs))
