"""The `dsim` command.  Each command imports what it needs when it runs, so `dsim --help` stays instant."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from dsim.cli_assignments import assignments, check_submission
from dsim.cli_lectures import lectures

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
        limit = None if full else report.LIMIT
        status = report.run(jobs, to, quiet=quiet, limit=limit, command=command, workers=min(2, os.cpu_count() or 1))
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; the report of the previous run, if any, is unchanged", err=True, fg="red")
        status = 2
    raise typer.Exit(status)


@app.command()
def show(
    scene: Annotated[str, typer.Argument(help="A scene; see --list.")] = "",
    to: Annotated[Path | None, typer.Option("--to", help="FILE.png: filmstrip; .gif, .mp4: animation.")] = None,
    stepper: Annotated[str, typer.Option("--stepper", help="Another stepper: BackwardEuler, rk4, ...")] = "",
    h: Annotated[float | None, typer.Option("--h", help="Another step size, s.")] = None,
    steps: Annotated[int | None, typer.Option("--steps", help="Another number of steps.")] = None,
    screen: Annotated[bool, typer.Option("--screen", help="Animate in a window.")] = False,
    energy: Annotated[Path | None, typer.Option("--energy", help="Draw energy over time (.png, .svg).")] = None,
    listed: Annotated[bool, typer.Option("--list", help="List the scenes.")] = False,
) -> None:
    """Simulate a scene and draw it: a filmstrip (SCENE.png unless --to says otherwise), or an animation.

    Exit code 0: drawn. 1: the run failed; what was completed is drawn. 2: bad usage.

    **Examples**

    `dsim show --list` - the scenes

    `dsim show cloth` - a filmstrip in cloth.png

    `dsim show cloth --to cloth.gif` - an animation

    `dsim show pendulum_stiff --stepper ForwardEuler` - see it blow up

    `dsim show kepler --stepper rk4 --steps 3000 --energy energy.png` - energy over three periods
    """
    from dsim.report import showing

    if listed or not scene:
        typer.echo(showing.listing())
        raise typer.Exit(0 if listed else 2)
    raise typer.Exit(showing.show(showing.prepared(scene, stepper, h, steps), to, energy, screen))


@app.command()
def plan(
    scene: Annotated[str, typer.Argument(help="A scene; see dsim show --list.")],
    stepper: Annotated[str, typer.Option("--stepper", help="Another stepper.")] = "",
    h: Annotated[float | None, typer.Option("--h", help="Another step size, s.")] = None,
    gradient: Annotated[bool, typer.Option("--gradient", help="Plan for a gradient too.")] = False,
    pay_back: Annotated[bool, typer.Option("--pay-back", help="What each effect costs and changes.")] = False,
    to: Annotated[Path | None, typer.Option("--to", help="Draw the pay-back (.png, .svg).", metavar="FILE")] = None,
    forbid: Annotated[
        list[str] | None, typer.Option("--forbid", help="Leave this effect out; warns if it acts.", metavar="EFFECT")
    ] = None,
    snapshots: Annotated[
        int | None, typer.Option("--snapshots", help="Take a gradient with K states kept.", metavar="K")
    ] = None,
) -> None:
    """What a run evaluates, what stays off and why, and what it really took.

    Exit code 0: no warning. 1: the plan warns, or the run failed. 2: bad usage.

    **Examples**

    `dsim plan cloth` - the plan, predicted and actual counts

    `dsim plan pendulum_stiff --stepper SymplecticEuler` - warns: h w_max is beyond the limit

    `dsim plan soft_body --pay-back` - what each effect costs, and what it changes

    `dsim plan soft_body --to pay_back.png` - the same as a picture

    `dsim plan cloth --forbid drag` - without one of its effects, and a warning that it would act

    `dsim plan chain --snapshots 5` - memory and recomputation of a gradient with 5 states kept, foretold and taken
    """
    from dsim.report import showing

    ready = showing.prepared(scene, stepper, h)
    raise typer.Exit(showing.planned(ready, gradient, pay_back, to, tuple(forbid or ()), snapshots))


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
def audit(
    program: Annotated[str, typer.Argument(help="FILE.py:FUNCTION; dsim's own cloth if none.")] = "",
    peers: Annotated[bool, typer.Option("--peers", help="JAX, Taichi, Warp and autograd, where installed.")] = False,
    peers_in: Annotated[Path, typer.Option("--peers-in", help="Where their programs lie.", metavar="DIR")] = Path(
        "tests/peers"
    ),
    planted: Annotated[bool, typer.Option("--planted", help="Find the planted bugs instead.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the verdicts (.png, .svg).", metavar="FILE")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
) -> None:
    """Three verdicts on a simulator: the program's derivative?  the physics'?  does it point downhill?

    FUNCTION is either `make(problem)`, the cloth in your framework: from the arrays of
    `dsim.studies.peers.cloth_problem` it returns (forward, gradient), both of (stiffness, v0), as in tests/peers/;
    or it takes nothing and returns a `dsim.studies.verdicts.Simulator`, any program of yours.

    Exit code 0: all three are good. 1: one is bad, or a planted bug was not found. 2: no verdict, or bad usage.

    **Examples**

    `dsim audit` - dsim's own cloth

    `dsim audit tests/peers/jax_cloth.py:make --plot verdicts.png` - the cloth in another framework

    `dsim audit mine.py:simulator --json` - any program of yours, for a script

    `dsim audit --peers` - the other simulators, from a checkout of dsim

    `dsim audit --planted` - the bugs that a checker must find
    """
    from dsim import catalog
    from dsim.report import auditing

    if (bool(program) + peers + planted) > 1:
        raise ValueError("give one of FILE.py:FUNCTION, --peers and --planted")
    if plot is not None and plot.suffix.lower() not in (".png", ".svg"):
        raise ValueError(f"--plot must end in .png or .svg; got {plot}")
    if planted:
        raise typer.Exit(auditing.run_planted(catalog.PLANTED, quiet))
    if peers and not peers_in.is_dir():
        raise FileNotFoundError(f"--peers-in must be a directory with the peers' programs; there is none at {peers_in}")
    raise typer.Exit(auditing.run(program, peers_in if peers else None, as_json, plot, quiet))


@app.command(name="hard-cases")
def hard_cases(
    numbers: Annotated[list[int] | None, typer.Argument(help="Cases to run; all of them if none.", metavar="N")] = None,
    listing: Annotated[bool, typer.Option("--list", help="Print set-ups and truths, run nothing.")] = False,
    to: Annotated[
        Path | None,
        typer.Option("--to", help="Write case_NN.png and hard_cases.json there; by default no file.", metavar="DIR"),
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="100 periods, 1e4 implicit steps: about a minute more.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
) -> None:
    """Where the naive method fails, next to one that survives.

    Exit code 0: every failure was reproduced and every survivor met its threshold. 1: not so. 2: bad usage.

    **Examples**

    `dsim hard-cases` - all of them, a row each

    `dsim hard-cases 2 8 --to pictures` - two of them, drawn side by side

    `dsim hard-cases --list` - what they are
    """
    from dsim import catalog
    from dsim.report import hard_cases as report
    from dsim.report.terminal import console
    from dsim.studies.hard_cases import select

    cases = select(catalog.HARD_CASES, numbers or ())
    if to is not None and to.exists() and not to.is_dir():
        raise ValueError(f"--to must be a directory; {to} is a file")
    if listing:
        console().print(report.case_list(cases))
        return
    try:
        status = report.run(cases, to, full, quiet)
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; nothing was written", err=True, fg="red")
        status = 2
    raise typer.Exit(status)


@app.command()
def accuracy(
    problem: Annotated[
        list[str] | None, typer.Argument(help="Problems, or `gradients`; by default all problems.")
    ] = None,
    to: Annotated[Path, typer.Option("--to", help="Directory of the results.", metavar="DIR")] = Path("dsim-accuracy"),
    quick: Annotated[
        bool, typer.Option("--quick", help="A small sweep, by default of two problems: a minute.")
    ] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Measure again what was measured before.")] = False,
) -> None:
    """What does accuracy cost?  Errors of states and gradients over seconds, for every stepper and SciPy's solvers.

    The problems: projectile, pendulum, kepler, chain, two-rates, cloth, and of rigid bodies free-top and heavy-top.
    `gradients` asks what a gradient costs by finite differences, complex steps, sensitivities and the adjoint for 1 to
    10,000 parameters, and whether it converges like the state.

    Writes a picture (PNG, SVG) a problem, `table.txt` and `accuracy.json`. An interrupted run is continued by the same
    command. Exit code 0: done. 1: a check of `gradients` is red. 2: bad usage, interrupted.

    **Examples**

    `dsim accuracy` - every problem: half an hour, and resumable

    `dsim accuracy kepler cloth --quick --to results` - two problems, a small sweep

    `dsim accuracy gradients` - some minutes; with --quick up to 1,000 parameters in half a minute
    """
    from dsim.report import accuracy as report

    try:
        status = report.run(problem or (), to, quick=quick, fresh=fresh)
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; run the same command again to go on", err=True, fg="red")
        raise typer.Exit(2) from None
    raise typer.Exit(status)


@app.command()
def optimise(
    name: Annotated[str, typer.Argument(help="A showcase; without one they are listed.")] = "",
    full: Annotated[bool, typer.Option("--full", help="The large version: up to half a minute.")] = False,
    listed: Annotated[bool, typer.Option("--list", help="List the showcases.")] = False,
    to: Annotated[
        Path | None,
        typer.Option("--to", help="Write pictures (PNG, SVG) there; by default no file.", metavar="DIR"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
) -> None:
    """Gradients put to work: control, identification, targeting, design, each with its success measured.

    Exit code 0: every check passed. 1: one did not. 2: bad usage, interrupted.

    **Examples**

    `dsim optimise` - what there is

    `dsim optimise targeting` - a net is thrown through gusts: two seconds

    `dsim optimise control --full --to pictures` - 14,400 numbers, a filmstrip and the convergence
    """
    from dsim import catalog
    from dsim.report import showcases as report
    from dsim.report.terminal import console
    from dsim.studies.showcases.model import select

    if listed or not name:
        console().print(report.listing())
        return
    try:
        status = report.run(select(catalog.SHOWCASES, name), to, full, quiet)
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; nothing was written", err=True, fg="red")
        status = 2
    raise typer.Exit(status)


@app.command()
def grade(
    number: Annotated[str, typer.Argument(help="The assignment: 01, 02, ...", metavar="NN")],
    submissions: Annotated[Path, typer.Argument(help="Directory of .py and .ipynb files.", metavar="SUBMISSIONS")],
    to: Annotated[Path, typer.Option("--to", help="Where the grades go.", metavar="DIR")],
    jobs: Annotated[int | None, typer.Option("--jobs", help="So many at a time, by default 1.", min=1)] = None,
    scheduler: Annotated[
        str, typer.Option("--scheduler", help="Grade on a dask cluster: tcp://host:8786", metavar="ADDRESS")
    ] = "",
    assignments: Annotated[
        Path | None, typer.Option("--assignments", help="Where the assignments lie.", metavar="DIR")
    ] = None,
    unsandboxed: Annotated[
        bool, typer.Option("--unsandboxed", help="Run submissions WITHOUT protection; marked in every result.")
    ] = False,
) -> None:
    """Grade a class: results.json and feedback.md for each submission, grades.csv and summary.md for all.

    Every submission runs in a sandbox; where none can be made, nothing is graded. A run that was stopped goes on where
    it was. With --scheduler the workers of a dask.distributed cluster grade, each after it has proved its own sandbox;
    submissions, hidden checks and the secret travel to them. Exit code 0: all graded. 2: bad usage, no sandbox,
    interrupted.

    **Examples**

    `dsim grade 01 handed-in --to grades` - one at a time

    `dsim grade 01 handed-in --to grades --jobs 2` - two at a time; the same command goes on after an interruption

    `dsim grade 01 handed-in --to grades --scheduler tcp://10.0.0.5:8786` - on a cluster (`pip install "dsim[cluster]"`)
    """
    from dsim.report import grading as report

    if jobs and scheduler:
        raise ValueError("give --jobs, for this machine, or --scheduler, whose workers say how many; not both")
    where = scheduler or jobs or 1
    try:
        raise typer.Exit(report.run(number, submissions, to, where, assignments, sandboxed=not unsandboxed))
    except KeyboardInterrupt:
        typer.secho("dsim: interrupted; run the same command again to go on", err=True, fg="red")
        raise typer.Exit(2) from None


app.add_typer(lectures, name="lectures")
app.add_typer(assignments, name="assignments")
app.command(name="check-submission")(check_submission)

references = typer.Typer(
    help="Reference problems with certified answers, for simulators in any language.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
)
app.add_typer(references, name="references")


@references.command(name="list")
def references_list() -> None:
    """The problems, their sizes and where their answers come from."""
    from dsim import catalog
    from dsim.report import references as report

    report.listing(catalog.ANSWERS)


@references.command(name="export")
def references_export(
    to: Annotated[Path, typer.Argument(help="New or empty directory, or an earlier export.", metavar="DIR")],
    names: Annotated[list[str] | None, typer.Argument(help="Problems; all by default.", metavar="[NAME]...")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
) -> None:
    """Write problems and answers as JSON and NPZ, with a schema, an index and a README, for use without Python.

    The directory appears whole or not at all. Every answer is certified again while it is written: half a minute.
    Exit code 0: written. 1: a certificate was not met, nothing was written. 2: bad usage.

    **Examples**

    `dsim references export answers` - every problem

    `dsim references export answers ball-symplectic-euler kepler` - two of them
    """
    from dsim import catalog
    from dsim.report import references as report

    raise typer.Exit(report.export(catalog.ANSWERS, to, names or (), quiet))


@references.command(name="check")
def references_check(
    directory: Annotated[Path, typer.Argument(help="An export.", metavar="DIR")],
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress on stderr.")] = False,
) -> None:
    """Is an export complete and unchanged, and does this dsim find the same numbers?

    Exit code 0: yes. 1: no; what differs is listed. 2: DIR is no export.

    **Examples**

    `dsim references check answers`
    """
    from dsim import catalog
    from dsim.report import references as report

    raise typer.Exit(report.check(catalog.ANSWERS, directory, quiet))


def main() -> None:
    """Entry point: a ValueError or missing file becomes one clear line and exit code 2, not a traceback."""
    try:
        app()
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        typer.secho(f"dsim: {error}", err=True, fg="red")
        raise SystemExit(2) from None
