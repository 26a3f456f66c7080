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


@app.command()
def check(
    function: Annotated[str | None, typer.Argument(help="FILE.py:FUNCTION, x -> (value, gradient).")] = None,
    at: Annotated[str, typer.Option("--at", help="x: .npy, .npz, .json, or 0.1,0.2", metavar="X")] = "",
    program: Annotated[str, typer.Option("--exec", help="A program in any language.", metavar="PROGRAM")] = "",
    form: Annotated[str, typer.Option("--format", help="Files of --exec: npz or json.")] = "npz",
    batch: Annotated[bool, typer.Option("--batch", help="PROGRAM takes x (B,n), gives value (B,).")] = False,
    timeout: Annotated[float, typer.Option("--timeout", help="Seconds for each call of PROGRAM.")] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the V-curve (.png, .svg).")] = None,
) -> None:
    """Is this gradient right?  Judges code that dsim did not write.

    Exit code 0: smooth, the gradient is right. 1: wrong. 2: kink, jump or noise, or bad usage.

    **Examples**

    `dsim check cost.py:cost --at x.npy` - cost(x) returns (value, gradient)

    `dsim check cost.py:cost --at 0.1,0.2 --plot v.png` - and draw the V-curve

    `dsim check --exec ./simulator --at x.npy` - run as `./simulator in.npz out.npz`: x in, value and gradient out

    `dsim check --exec "julia cost.jl" --format json --batch --at x.npy --json` - many points a call, for a script
    """
    import json

    from dsim.report.terminal import counting
    from dsim.studies import check_gradient, foreign

    if bool(function) == bool(program):
        raise ValueError("give either FILE.py:FUNCTION or --exec PROGRAM")
    if not at:
        raise ValueError("--at must give the point x: a file, or numbers like 0.1,0.2")
    if plot is not None and plot.suffix.lower() not in (".png", ".svg"):
        raise ValueError(f"--plot must end in .png or .svg; got {plot}")
    f = foreign.load_function(function) if function else foreign.Program(program, form, batch, timeout)
    with counting(f, "evaluations") as counted:
        report = check_gradient(counted, foreign.read_point(at))
    if report.given is None:
        raise ValueError(f"{function or program} must return (value, gradient); it returned a value alone")
    if plot is not None:
        from dsim.pictures.gradient_check import v_curve
        from dsim.pictures.style import save

        save(v_curve(report), plot)
    typer.echo(json.dumps(report.to_dict(), indent=2) if as_json else str(report))
    raise typer.Exit({"smooth": 0, "wrong": 1}.get(report.verdict, 2))


@app.command()
def accuracy(
    problem: Annotated[list[str] | None, typer.Argument(help="Problems; all of them by default.")] = None,
    to: Annotated[Path, typer.Option("--to", help="Directory of the results.", metavar="DIR")] = Path("dsim-accuracy"),
    quick: Annotated[
        bool, typer.Option("--quick", help="A small sweep, by default of two problems: half a minute.")
    ] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Measure again what was measured before.")] = False,
) -> None:
    """What does accuracy cost?  Errors of states and gradients over seconds, for every stepper and SciPy's solvers.

    Writes a picture (PNG, SVG) a problem, `table.txt` and `accuracy.json`. An interrupted run is continued by the same
    command. Exit code 0: done. 2: bad usage, interrupted.

    **Examples**

    `dsim accuracy` - every problem, some minutes

    `dsim accuracy kepler cloth --quick --to results` - two problems, a small sweep
    """
    from dsim.report import accuracy as report

    try:
        report.run(problem or (), to, quick=quick, fresh=fresh)
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; run the same command again to go on", err=True, fg="red")
        raise typer.Exit(2) from None


def main() -> None:
    """Entry point: a ValueError or missing file becomes one clear line and exit code 2, not a traceback."""
    try:
        app()
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        typer.secho(f"dsim: {error}", err=True, fg="red")
        raise SystemExit(2) from None
