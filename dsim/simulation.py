"""Running a stepper: `simulate`, and what it returns."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dsim.arrays.checks import Array, as_array, as_count, as_step
from dsim.arrays.frozen import replace
from dsim.planning import Plan
from dsim.solve.newton import Status
from dsim.steppers import body_run
from dsim.steppers.checkpoints import Checkpoints
from dsim.steppers.explicit_run import ExplicitRun
from dsim.steppers.replay import Replay, RowReplay, Snapshots, StepReplay
from dsim.steppers.stepper import FACTOR_BYTES, Counters, Ode, Step, Stepper

Keep = Literal["states", "steps", "factors"] | Checkpoints


class SimulationError(RuntimeError):
    """A run that could not go on.  `trajectory` holds the steps that were completed, `status` says why it ended."""

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory
        self.status = trajectory.status


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States at t_0, ..., t_N.  t (N+1,) s, `.y` (N+1,ny).

    status: `converged`, or why the step after the last row failed.  counters: what the run cost.
    steps: every Step, when the run kept them; otherwise `step(n)` makes one from the states.
    """

    stepper: Stepper | None
    system: Ode | None
    h: float
    t: Array
    states: Array | None  # None where the run has them
    status: Status = Status.CONVERGED
    counters: Counters = Counters()
    steps: tuple[Step, ...] | None = None
    run: ExplicitRun | None = field(default=None, repr=False)  # an explicit run, ready to carry gradients back
    snapshots: Snapshots | None = field(default=None, repr=False)  # what a run with Checkpoints kept
    positions: int | None = None  # length of q, of a trajectory without its system

    def __repr__(self) -> str:
        name = type(self.stepper).__name__
        return f"<Trajectory: {name}, h = {self.h:g} s, {len(self.t) - 1} steps, {self.status}>"

    @cached_property
    def y(self) -> Array:
        """States (N+1,ny); an explicit run turns its coordinate rows into them when they are first asked for."""
        if self.states is not None:
            return self.states
        if self.snapshots is not None:
            raise ValueError(
                f"this trajectory keeps {self.snapshots.checkpoints}, not all its states: use .last, "
                'adjoint(trajectory, dJdy) with a callable dJdy(n, y), or keep="states"'
            )
        assert self.run is not None
        return self.run.public_states()

    @property
    def tape_bytes(self) -> int:
        """Memory held for the way back: states, and what the run kept beside them."""
        if self.snapshots is not None:
            return self.snapshots.nbytes
        if self.run is not None:
            return self.run.nbytes
        steps = self.steps or ()
        return self.y.nbytes + sum(s.factor_bytes + sum(k.nbytes for k in s.rates or ()) for s in steps)

    @property
    def last(self) -> Array:
        """The last state y_N (ny,), without making rows of the others."""
        if self.snapshots is not None:
            return self.snapshots.public_last
        return self.run.last() if self.states is None and self.run is not None else self.y[-1]

    @property
    def first(self) -> Array:
        """The first state y_0 (ny,), as it was given."""
        if self.snapshots is not None:
            return self.snapshots.y0
        return self.run.y0 if self.states is None and self.run is not None else self.y[0]

    @property
    def n(self) -> int:
        """Length of q; of bodies, whose quaternions count."""
        if self.system is None:
            return self.y.shape[1] // 2 if self.positions is None else self.positions
        return self.system.width

    @property
    def q(self) -> Array:
        """Positions (N+1,n); the whole state of a flow."""
        return self.y[:, : self.n]

    @property
    def v(self) -> Array:
        """Velocities (N+1,n); empty for a flow."""
        return self.y[:, self.n :]

    def attached(self) -> tuple[Stepper, Ode]:
        """The stepper and the system, or ValueError for a trajectory loaded without them."""
        if self.stepper is None or self.system is None:
            raise ValueError("this trajectory has no system: load it with Trajectory.load(path, stepper, system)")
        return self.stepper, self.system

    def differentiable(self) -> tuple[Stepper, Ode]:
        """`attached`, and ValueError for a run that ended before its last step."""
        stepper, system = self.attached()
        if self.status is not Status.CONVERGED:
            raise ValueError(
                f"trajectory must be a run that reached its end; {explain(self)} (its first part: trajectory.completed)"
            )
        return stepper, system

    @property
    def completed(self) -> Trajectory:
        """The steps that were taken, as a trajectory that ends with the last good one."""
        return replace(self, status=Status.CONVERGED)

    def step(self, n: int) -> Step:
        """The step from t_n to t_{n+1}, with its history."""
        if not 0 <= n < len(self.t) - 1:
            raise ValueError(f"n must be a step from 0 to {len(self.t) - 2}; got {n}")
        if self.steps is not None:
            return self.steps[n]
        return Step(float(self.t[n]), self.h, self._state(n), self._state(n + 1))

    def start(self) -> Step:
        """The step that made the first state's past."""
        stepper, system = self.attached()
        return stepper.start(system, float(self.t[0]), self.first, self.h)

    def _state(self, n: int) -> Array:
        stepper, _ = self.attached()
        if stepper.history == 1:
            return self.y[n]
        return np.concatenate([self.y[n], self.y[n - 1]]) if n else self.start().y1

    def save(self, path: str | Path) -> None:
        """Write t, y, h, status and counters as `.npz`: to a temporary file first, then renamed."""
        path = Path(path)
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        data = io.BytesIO()
        np.savez_compressed(
            data, t=self.t, y=self.y, h=self.h, status=str(self.status), n=self.n,
            **{f"counter_{name}": value for name, value in asdict(self.counters).items()},
        )  # fmt: skip
        try:
            temporary.write_bytes(data.getvalue())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | Path, stepper: Stepper | None = None, system: Ode | None = None) -> Trajectory:
        """Read what `save` wrote.  Give the stepper and the system again to differentiate the trajectory."""
        try:
            content = io.BytesIO(Path(path).read_bytes())  # np.load leaves a damaged file open
            with np.load(content, allow_pickle=False) as data:
                values = {name: data[name] for name in data.files}
            counters = Counters(**{k[8:]: int(v) for k, v in values.items() if k.startswith("counter_")})
            y, t = values["y"], values["t"]
            if y.ndim != 2 or t.shape != y.shape[:1]:
                raise ValueError(f"t has shape {t.shape}, y {y.shape}")
            if system is not None and y.shape[1] != system.size:
                raise ValueError(f"path must hold states of size {system.size}; {path} has {y.shape[1]}")
            state = float(values["h"]), t, y, Status(str(values["status"])), counters
            return cls(stepper, system, *state, positions=int(values["n"]))
        except FileNotFoundError:
            raise
        except (KeyError, OSError, EOFError, TypeError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
            raise ValueError(f"path must be a trajectory written by save; {path} is not ({error})") from error
        except ValueError as error:
            if "must hold states" in str(error):
                raise
            raise ValueError(f"path must be a trajectory written by save; {path} is not ({error})") from error


def simulate(stepper: Stepper, system: Ode, y0: Any, h: float, steps: int, keep: Keep = "states") -> Trajectory:
    """Take `steps` steps of size h from y0 at t = 0.

    y0 (ny,) = [q, v]; pinned points do not move, whatever their velocity in y0.  keep: "states" for `.y` alone,
    "steps" for every Step too, which saves the adjoint a force evaluation a step; "factors" for the band factors of
    implicit steps as well, within `FACTOR_BYTES`: the adjoint solves by conjugate gradients with them, to 1e-11;
    `Checkpoints(10)` for ten states at a time, the adjoint taking steps again, with the bits of keep="states".
    Raises ValueError on bad input, SimulationError (with the completed part) at a step that fails.

    >>> import numpy as np
    >>> from dsim.effects import Gravity
    >>> from dsim.steppers import SymplecticEuler
    >>> from dsim.system import System
    >>> ball = System(mass=[1.0], effects=[Gravity([0.0, -10.0])], dimension=2)
    >>> simulate(SymplecticEuler(), ball, [0, 0, 3, 10], h=0.5, steps=2).y[-1].tolist()
    [3.0, 2.5, 3.0, 0.0]
    """
    trajectory = record(stepper, system, y0, h, steps, keep)
    if trajectory.status is not Status.CONVERGED:
        raise SimulationError(explain(trajectory), trajectory)
    return trajectory


def record(stepper: Stepper, system: Ode, y0: Any, h: float, steps: int, keep: Keep = "states") -> Trajectory:
    """`simulate`, but a failed step ends the trajectory with its status instead of raising."""
    if isinstance(stepper, type) or not hasattr(stepper, "step"):
        raise ValueError(f"stepper must be a method such as BackwardEuler(); got {stepper!r:.60}")
    if not hasattr(system, "stage_residual"):
        raise ValueError(f"system must be a System or a Flow; got {system!r:.60}")
    y0 = as_array("y0", y0, (system.size,))
    system.check_start(y0)
    h, steps = as_step(h), as_count("steps", steps)
    if not isinstance(keep, Checkpoints) and keep not in ("states", "steps", "factors"):
        raise ValueError(f'keep must be "states", "steps", "factors" or Checkpoints(10); got {keep!r:.60}')
    rows = Plan(system, stepper, y0, h).rows
    if isinstance(keep, Checkpoints):
        replay: Replay = RowReplay(ExplicitRun(stepper, system, h)) if rows else StepReplay(stepper, system, h)
        return _checkpointed(Snapshots(keep, replay, y0), (stepper, system), h, steps)
    if rows:
        return _explicit(ExplicitRun(stepper, system, h), y0, steps, keep)
    bodies: Any = system
    if keep == "states" and body_run.applies(stepper, system):
        return _bodies(body_run.BodyRun(stepper, bodies, h), (stepper, system), y0, steps)
    y = np.empty((steps + 1, system.size))
    y[0] = y0
    return _stepwise(stepper, system, y, h, keep)


def _explicit(run: ExplicitRun, y0: Array, steps: int, keep: Keep) -> Trajectory:
    """All steps at once, on coordinate rows."""
    with np.errstate(all="ignore"):
        done = run.evaluate(y0, steps, keep_tape=keep != "states")
    status = Status.CONVERGED if done == steps else Status.NOT_FINITE
    taken = done + (status is not Status.CONVERGED)
    counters = Counters(forces=taken * run.stages)
    t: Array = run.h * np.arange(done + 1, dtype=float)
    return Trajectory(run.stepper, run.system, run.h, t, None, status, counters, run=run)


def _bodies(run: body_run.BodyRun, method: tuple[Stepper, Ode], y0: Array, steps: int) -> Trajectory:
    """All steps at once, on component rows."""
    with np.errstate(all="ignore"):
        y, forces = run.evaluate(y0, steps)
    done = len(y) - 1
    status = Status.CONVERGED if done == steps else Status.NOT_FINITE
    t: Array = run.h * np.arange(done + 1, dtype=float)
    return Trajectory(*method, run.h, t, y, status, Counters(forces=forces))


def _checkpointed(snapshots: Snapshots, method: tuple[Stepper, Ode], h: float, steps: int) -> Trajectory:
    """A few states kept."""
    snapshots.forward(steps)
    t: Array = h * np.arange(snapshots.done + 1, dtype=float)
    return Trajectory(*method, h, t, None, snapshots.status, snapshots.counters, snapshots=snapshots)


def _stepwise(stepper: Stepper, system: Ode, y: Array, h: float, keep: Keep) -> Trajectory:
    """Step after step, each with its status."""
    taken: list[Step] = []
    steps, done = len(y) - 1, 0
    budget = FACTOR_BYTES if keep == "factors" else 0
    with np.errstate(over="ignore", invalid="ignore"):
        start = stepper.start(system, 0.0, y[0], h)
        state, counters, status = start.y1, start.counters, start.status
        while done < steps and status is Status.CONVERGED:
            step = stepper.step(system, done * h, state, h)
            state, counters, status = step.y1, counters + step.counters, step.status
            if status is Status.CONVERGED:
                done += 1
                y[done] = state[: system.size]
                if keep != "states":
                    budget -= step.factor_bytes
                    taken.append(step if budget >= 0 else replace(step, factors=None))
    kept = None if keep == "states" else tuple(taken)
    t: Array = h * np.arange(done + 1, dtype=float)
    return Trajectory(stepper, system, h, t, y[: done + 1], status, counters, kept)


def explain(trajectory: Trajectory) -> str:
    """One line on a run that failed: the step, the status, what to do."""
    n = len(trajectory.t) - 1
    name = type(trajectory.stepper).__name__
    curved = getattr(trajectory.system, "curved", False)
    tried = getattr(trajectory.stepper, "globalize", "") == "energy"
    energy = "" if curved or tried else "globalize='energy', or "
    advice = {
        Status.NOT_FINITE: "the state overflowed or a force is NaN; use a smaller h or an implicit stepper",
        Status.MAX_ITERATIONS: f"Newton did not converge; use {energy}a smaller h or more max_iterations",
        Status.LINE_SEARCH_FAILED: f"no step length lowered the residual; use {energy}a smaller h",
        Status.SINGULAR: "Newton's matrix has no inverse (a fold, or h is too large) or is not finite",
    }[trajectory.status]
    return f"{name} failed in step {n} (t = {n * trajectory.h:.6g}): {trajectory.status}; {advice}"
