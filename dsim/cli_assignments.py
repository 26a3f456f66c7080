"""`dsim assignments` and `dsim check-submission`.  Each command imports what it needs when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

assignments = typer.Typer(
    help="The assignments: list them, hand them out, check that they are fair.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)

Where = Annotated[
    Path | None, typer.Option("--assignments", help="Where the assignments lie, if not here.", metavar="DIR")
]


@assignments.command(name="list")
def list_all(where: Where = None) -> None:
    """Numbers, titles, points and items."""
    from dsim.report import assignments as report

    report.listing(where)


@assignments.command()
def release(
    numbers: Annotated[list[str], typer.Argument(help="01, 02, ...", metavar="NN...")],
    to: Annotated[Path, typer.Option("--to", help="Directory for students.", metavar="DIR")],
    notebook: Annotated[bool, typer.Option("--notebook", help="The stub as .ipynb in place of .py.")] = False,
    where: Where = None,
) -> None:
    """Write what students get: the stub, the handout, the kit and the public checks, and nothing else.

    Exit code 0: written. 2: bad usage, or the folder is there already.

    **Examples**

    `dsim assignments release 01 --to handouts`

    `dsim assignments release 01 02 03 --to handouts --notebook` - a cell a function, tagged for grading
    """
    from dsim.report import assignments as report

    report.release(numbers, to, notebook, where)


@assignments.command()
def check(
    numbers: Annotated[list[str] | None, typer.Argument(help="All by default.", metavar="[NN]...")] = None,
    where: Where = None,
) -> None:
    """Is every assignment fair?  The solution and its alternatives get everything, the stub nothing and no traceback,
    and each mutant loses exactly the items it must.

    Exit code 0: yes. 1: no. 2: bad usage.

    **Examples**

    `dsim assignments check 01`
    """
    from dsim.report import assignments as report

    raise typer.Exit(report.check(numbers or (), where))


@assignments.command()
def gradescope(
    number: Annotated[str, typer.Argument(help="01, 02, ...", metavar="NN")],
    to: Annotated[Path, typer.Option("--to", help="The zip to write.", metavar="FILE.zip")],
    secret: Annotated[
        Path | None, typer.Option("--secret", help="By default .dsim-secret beside the zip.", metavar="FILE")
    ] = None,
    other_user: Annotated[
        bool, typer.Option("--other-user-there", help="Where no sandbox can be made there: weaker isolation.")
    ] = False,
    where: Where = None,
) -> None:
    """Write an autograder for Gradescope, and say which isolation submissions have there.

    The secret, from which hidden inputs are drawn, is made if it is not there; it lies in the zip.
    Exit code 0: written. 2: bad usage.

    **Examples**

    `dsim assignments gradescope 01 --to 01.zip` - grades there in the sandbox, or not at all

    `dsim assignments gradescope 01 --to 01.zip --other-user-there` - else as another user, marked in every result

    `dsim assignments gradescope 01 --to 01.zip --secret grades/.dsim-secret` - hidden inputs as in that class
    """
    from dsim.report import assignments as report

    report.gradescope(number, to, secret, other_user, where)


def check_submission(
    file: Annotated[Path, typer.Argument(help="Your .py or .ipynb.", metavar="FILE")],
    number: Annotated[str, typer.Option("--assignment", help="NN, if the name does not begin with it.")] = "",
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="By default FILE-feedback beside the file.", metavar="DIR")
    ] = None,
    where: Where = None,
) -> None:
    """The public items on your own file, on your own machine, with hints, and pictures of arrays that are off.

    The hidden items count as well.

    Exit code 0: every public item is complete. 1: points are missing. 2: bad usage.

    **Examples**

    `dsim check-submission 01_time_stepping.py`
    """
    from dsim.report import assignments as report

    raise typer.Exit(report.check_submission(file, number, where, pictures))
