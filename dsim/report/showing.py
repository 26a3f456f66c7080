"""`dsim show`: simulate a scene, draw it, say what happened."""

from __future__ import annotations

import difflib
from dataclasses import replace
from pathlib import Path

import numpy as np

from dsim import catalog
from dsim.gradients import adjoint
from dsim.pictures import animation
from dsim.pictures import plan as plan_pictures
from dsim.pictures import scene as pictures
from dsim.pictures.style import save
from dsim.planning import Plan, plan
from dsim.report.terminal import console, waiting
from dsim.scenes import Scene
from dsim.simulation import Trajectory, explain, record
from dsim.solve import Status
from dsim.steppers import RuleStepper
from dsim.steppers.checkpoints import Checkpoints
from dsim.studies import effect_cost
from dsim.system import System

FILMSTRIPS, ANIMATIONS = (".png", ".svg"), (".gif", ".mp4")


def listing() -> str:
    """The scenes, a line each."""
    return "\n".join(f"{build.__name__:16s} {build().summary}" for build in catalog.SCENES)


def prepared(name: str, stepper: str = "", h: float | None = None, steps: int | None = None) -> Scene:
    """The scene of that name with what was asked for exchanged.  Raises ValueError with what might have been meant."""
    builders = {build.__name__: build for build in catalog.SCENES}
    scene: Scene = builders[_meant("scene", name.replace("-", "_").lower(), list(builders))]()
    return replace(
        scene,
        stepper=_stepper(stepper) if stepper else scene.stepper,
        h=scene.h if h is None else h,
        steps=scene.steps if steps is None else steps,
    )


def _stepper(name: str) -> RuleStepper:
    known = {type(stepper).__name__.lower(): stepper for stepper in (*catalog.STEPPERS, *catalog.BODY_STEPPERS)}
    names = [type(stepper).__name__ for stepper in known.values()]
    plain = name.replace("_", "").replace("-", "").lower()
    return known[plain] if plain in known else known[_meant("--stepper", name, names).lower()]


def _meant(what: str, name: str, known: list[str]) -> str:
    if name in known:
        return name
    close = difflib.get_close_matches(name, known, n=2, cutoff=0.5)
    hint = f"; did you mean {' or '.join(close)}?" if close else f"; there are {', '.join(known)}"
    raise ValueError(f"{what} must be a known name; got {name!r}{hint}")


def show(scene: Scene, to: Path | None = None, energy: Path | None = None, screen: bool = False) -> int:
    """Run and draw; the exit code: 0, or 1 for a run that failed (what was completed is drawn all the same)."""
    target = to or Path(f"{scene.name}.png")
    _check_request(scene, target, energy, screen)
    err = console(stderr=True)
    with waiting(err, f"simulating {scene.name}"):
        trajectory = record(scene.stepper, scene.system, scene.y0, scene.h, scene.steps)
    failed = trajectory.status is not Status.CONVERGED
    if failed:
        err.print(explain(trajectory), style="red", markup=False, soft_wrap=True)
    trajectory = visible(trajectory)
    if len(trajectory.t) - 1 < scene.steps:
        err.print(f"drawn to t = {trajectory.t[-1]:.4g} s, before it leaves the picture", markup=False)
    with waiting(err, f"drawing {target}"):
        if target.suffix.lower() in ANIMATIONS:
            animation.write(scene, trajectory, target)
        elif to is not None or not screen:
            save(pictures.filmstrip(scene, trajectory), target)
        if energy is not None:
            save(pictures.energy(scene, trajectory), energy)
    written = [str(path) for path in (target if to or not screen else None, energy) if path is not None]
    if written:
        console().print(f"wrote {', '.join(written)}", markup=False, soft_wrap=True)
    if screen:
        animation.on_screen(scene, trajectory)
    return int(failed)


def _check_request(scene: Scene, target: Path, energy: Path | None, screen: bool) -> None:
    """All that can be refused is refused before the run."""
    _check_suffix("--to", target, FILMSTRIPS + ANIMATIONS)
    if energy is not None:
        _check_suffix("--energy", energy, FILMSTRIPS)
        if not isinstance(scene.system, System):
            raise ValueError(f"--energy needs a scene of masses; {scene.name} is a first-order flow")
    if screen:
        animation.require_screen()


def visible(trajectory: Trajectory) -> Trajectory:
    """The trajectory up to the first state that lies a hundred times farther out than the start."""
    reach = np.abs(trajectory.q).max(axis=1)
    beyond = np.flatnonzero(reach > 100 * max(1.0, float(reach[0])))
    end = int(beyond[0]) + 1 if beyond.size else len(trajectory.t)
    return replace(trajectory, t=trajectory.t[:end], states=trajectory.y[:end], run=None, steps=None)


def _check_suffix(name: str, path: Path, known: tuple[str, ...]) -> None:
    if path.suffix.lower() not in known:
        raise ValueError(f"{name} must end in {', '.join(known)}; got {path}")


def planned(
    scene: Scene,
    gradient: bool = False,
    pay_back: bool = False,
    to: Path | None = None,
    forbid: tuple[str, ...] = (),
    snapshots: int | None = None,
) -> int:
    """Print the plan of a scene and what the run took; the exit code: 1 where the plan warns or the run fails.

    to: draw the pay-back there.  snapshots: take a gradient with so many states kept, too.
    """
    few = None if snapshots is None else Checkpoints(snapshots)
    if to is not None:
        _check_suffix("--to", to, FILMSTRIPS)
    want = ("gradient",) if gradient or few else ()
    made = plan(scene.system, scene.stepper, scene.y0, scene.h, want, forbid)
    scene = replace(scene, system=made.system)
    out, err = console(), console(stderr=True)
    out.print(str(made), markup=False, soft_wrap=True)
    with waiting(err, f"simulating {scene.name}"):
        trajectory = record(scene.stepper, scene.system, scene.y0, scene.h, scene.steps, few or "states")
    out.print(made.compared(trajectory.counters, len(trajectory.t) - 1), markup=False, soft_wrap=True)
    failed = trajectory.status is not Status.CONVERGED
    if failed:
        err.print(explain(trajectory), style="red", markup=False, soft_wrap=True)
    elif few is not None:
        _print_recomputation(made, trajectory, few)
    if (pay_back or to is not None) and not failed:
        with waiting(err, "leaving out one effect after another"):
            rows = effect_cost.pay_back(scene)
        out.print(f"{'effect':18s} {'time with/without':>18s} {'change when left out':>21s}", markup=False)
        for row in rows:
            change = f"{row.change:.1%}" if np.isfinite(row.change) else "fails without"
            out.print(f"{row.effect:18s} {row.cost:18.2f} {change:>21s}", markup=False)
        if to is not None:
            save(plan_pictures.pay_back(scene.name, rows), to)
            out.print(f"wrote {to}", markup=False, soft_wrap=True)
    return int(failed or bool(made.warnings))


def _print_recomputation(made: Plan, trajectory: Trajectory, few: Checkpoints) -> None:
    """What a gradient with snapshots was to take, and what it took."""
    steps = len(trajectory.t) - 1
    with waiting(console(stderr=True), "the way back"):
        again = adjoint(trajectory, np.ones(made.system.size)).recomputed
    out = console()
    size = f"{8 * made.stepper.history * made.system.size} bytes each"  # a two-step method's state is two
    out.print(f"gradient of {steps} steps, {few.snapshots} snapshots and 2 states at hand, {size}", markup=False)
    out.print(f" predicted: {made.recomputation(steps, few)}", markup=False, soft_wrap=True)
    out.print(f" actual:    {trajectory.tape_bytes} bytes, {steps} + {again} = {steps + again} steps", markup=False)
