"""p -> states and its transposed derivative, in NumPy: what the layers of every library wrap."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from dsim.arrays.checks import Array
from dsim.gradients.adjoint import adjoint
from dsim.gradients.objectives import Run, Variables
from dsim.simulation import SimulationError, Trajectory, explain
from dsim.solve.newton import Status

Output = Literal["path", "last"]

TAPE_BYTES = 2**28
TWICE = "dsim's layer is differentiated once; for second derivatives of an objective see ReducedObjective.hessp"


def missing(layer: str, library: str, package: str) -> ImportError:
    """What to install."""
    return ImportError(f"{layer} needs {library}: pip install {package}, or pip install 'dsim[layers]' for every layer")


@dataclass(frozen=True, eq=False)
class StateMap:
    """p (k,) -> all states (N+1,ny), or the last one (ny,)."""

    run: Run
    variables: Variables
    output: Output = "path"

    def __post_init__(self) -> None:
        if not callable(self.run):
            raise ValueError(f"run must be a callable (system, y0) -> trajectory; got {self.run!r:.60}")
        if not isinstance(self.variables, Variables):
            raise ValueError(
                f"variables must be Variables(system, y0, ['velocities']), or other names; got {self.variables!r:.60}"
            )
        if self.output not in ("path", "last"):
            raise ValueError(f'output must be "path" or "last"; got {self.output!r:.60}')

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Of the states.  The number of steps is known to `run` alone: it is called once, at `variables.start`."""
        size = self.variables.system.size
        if self.output == "last":
            return (size,)
        return (len(self._checked(self.run(*self.variables.place(self.variables.start))).t), size)

    def trajectory(self, p: Any) -> Trajectory:
        """The run at p; SimulationError, with its status, where it ended early."""
        trajectory = self._checked(self.run(*self.variables.place(p)))
        shape = (len(trajectory.t), self.variables.system.size)
        if self.output == "path" and shape != self.shape:
            raise ValueError(f"run must take the same number of steps for every p; got {shape} after {self.shape}")
        return trajectory

    def states(self, trajectory: Trajectory) -> Array:
        return trajectory.last if self.output == "last" else trajectory.y

    def pullback(self, trajectory: Trajectory, bar: Any) -> Array:
        """(dy/dp)^T bar, (k,)."""
        return self.variables.gather(adjoint(trajectory, bar))

    @staticmethod
    def _checked(trajectory: Any) -> Trajectory:
        if not isinstance(trajectory, Trajectory):
            raise ValueError(f"run must return a trajectory; got {trajectory!r:.60}")
        if trajectory.status is not Status.CONVERGED:
            raise SimulationError(explain(trajectory), trajectory)
        return trajectory


@dataclass(frozen=True, eq=False)
class Tape:
    """The last runs of a StateMap, for the way back; one that is no longer there is run again, to the same bits."""

    scene: StateMap
    limit: int = TAPE_BYTES
    _kept: dict[bytes, Trajectory] = field(default_factory=dict, init=False, repr=False)  # the oldest first

    def states(self, p: Any) -> Array:
        return self.scene.states(self.trajectory(p))

    def pullback(self, p: Any, bar: Any) -> Array:
        return self.scene.pullback(self.trajectory(p), bar)

    def trajectory(self, p: Any) -> Trajectory:
        key = np.asarray(p, dtype=float).tobytes()
        found = self._kept.pop(key, None) or self.scene.trajectory(p)
        self._kept[key] = found
        while len(self._kept) > 1 and sum(kept.tape_bytes for kept in self._kept.values()) > self.limit:
            del self._kept[next(iter(self._kept))]
        return found
