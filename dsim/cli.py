"""The `dsim` command.  Each command imports what it needs when it runs, so `dsim --help` stays instant."""

from __future__ import annotations

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


def main() -> None:
    """Entry point: a ValueError or missing file becomes one clear line and exit code 2, not a traceback."""
    try:
        app()
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        typer.secho(f"dsim: {error}", err=True, fg="red")
        raise SystemExit(2) from None
