"""The `dsim` command.  Each command imports what it needs when it runs, so `dsim --help` stays instant."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="dsim",
    help="Differentiable simulation you can read, teach from and check your own code against.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


@app.callback()
def root() -> None:
    """Commands share exit codes: 0 all is well, 1 something is wrong, 2 no verdict or bad usage."""


@app.command()
def verify(
    to: Annotated[Path, typer.Option("--to", help="Directory of the report.", metavar="DIR")] = Path("dsim-report"),
    full: Annotated[bool, typer.Option("--full", help="The long studies too: minutes, not seconds.")] = False,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="One section; may be repeated.", metavar="KEY")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the closing line only.")] = False,
) -> None:
    """Check this installation and write what came out, with pictures, to one HTML page.

    Exit code 0: every check passed. 1: something is red. 2: no verdict (bad usage, interrupted).

    **Examples**

    `dsim verify` - all checks in less than 90 seconds; the page is `dsim-report/index.html`

    `dsim verify --only environment` - one section

    `dsim verify --full --to report` - the long studies, into another directory
    """
    from dsim.report import sections
    from dsim.report import verify as report

    jobs = report.select(sections.jobs(full), only or ())
    command = " ".join(["dsim verify", *["--full"] * full, *(f"--only {key}" for key in only or ())])
    try:
        status = report.run(jobs, to, quiet=quiet, limit=None if full else report.LIMIT, command=command)
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; the report of the previous run, if any, is unchanged", err=True, fg="red")
        status = 2
    raise typer.Exit(status)


def main() -> None:
    """Entry point: a ValueError or missing file becomes one clear line and exit code 2, not a traceback."""
    try:
        app()
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        typer.secho(f"dsim: {error}", err=True, fg="red")
        raise SystemExit(2) from None
