"""What the three verdicts ask of a program: two callables and the names of its numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, as_array, as_count, as_step
from dsim.gradients.adjoint import adjoint
from dsim.gradients.objectives import Variables
from dsim.simulation import Trajectory, record
from dsim.solve.newton import Status
from dsim.steppers.stepper import Stepper

STARTS = ("y0", "positions", "velocities", "q0", "v0")  # usual names of the initial state


@dataclass(frozen=True, eq=False)
class Simulator:
    """A program with its gradient, dsim's or anybody's.

    x (k,): the numbers it depends on.  simulate: (x, steps, h) -> the last state y (ny,).  gradient: (x, steps, h, w)
    -> d(w . y)/dx (k,) as the program finds it.  h s and steps: the run to judge.  blocks: name -> indices of x, by
    default one block "x".  start: the blocks that are the initial state; by default those called "y0", "positions",
    "velocities", "q0" or "v0", else all.  A program that returns its loss has ny = 1.  Raises ValueError on bad input:
    every entry of x must lie in a block, or nothing would be said of it.
    """

    name: str
    x: Array
    simulate: Callable[[Array, int, float], Any]
    gradient: Callable[[Array, int, float, Array], Any]
    h: float
    steps: int
    blocks: Mapping[str, Any] = field(default_factory=dict)
    start: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        x = as_array("x", self.x, (None,))
        for label in ("simulate", "gradient"):
            if not callable(getattr(self, label)):
                raise ValueError(f"{label} must be callable; got {getattr(self, label)!r:.60}")
        blocks = {name: _indices(name, places, len(x)) for name, places in self.blocks.items()}
        blocks = blocks or {"x": np.arange(len(x))}
        if empty := [name for name, places in blocks.items() if not len(places)]:
            raise ValueError(f"blocks[{empty[0]!r}] must name entries of x; got none")
        if len(left := np.setdiff1d(np.arange(len(x)), np.concatenate(list(blocks.values())))):
            raise ValueError(f"blocks must cover every entry of x; {left[0]} lies in none")
        start = tuple(self.start) or tuple(name for name in blocks if name in STARTS) or tuple(blocks)
        if unknown := [name for name in start if name not in blocks]:
            raise ValueError(f"start must name blocks, {', '.join(blocks)}; got {unknown[0]!r}")
        values = {"x": x, "h": as_step(self.h), "steps": as_count("steps", self.steps, 1)}
        for label, value in (values | {"blocks": blocks, "start": start}).items():
            object.__setattr__(self, label, value)

    @property
    def duration(self) -> float:
        """h * steps, s."""
        return self.h * self.steps

    @property
    def scale(self) -> Array:
        """A typical size for every entry of x (k,): the root mean square of its block, 1 where that is 0."""
        scale = np.ones(len(self.x))
        for places in self.blocks.values():
            scale[places] = np.sqrt(np.mean(self.x[places] ** 2)) or 1.0
        return scale

    def state(self, x: Array, steps: int | None = None, h: float | None = None) -> NDArray[Any]:
        """y (ny,) in the precision the program works in; not finite where the run failed."""
        y = np.asarray(self._asked("simulate", x.copy(), steps or self.steps, h or self.h))
        if not (y.ndim <= 1 and y.size and np.issubdtype(y.dtype, np.floating)):
            raise ValueError(f"simulate must return one state (ny,) of floats; {self.name} gave {y.dtype} {y.shape}")
        return np.atleast_1d(y)

    def pulled(self, w: Array, x: Array | None = None, steps: int | None = None, h: float | None = None) -> Array:
        """d(w . y)/dx (k,)."""
        x = self.x if x is None else x
        gradient = np.asarray(self._asked("gradient", x.copy(), steps or self.steps, h or self.h, w), dtype=float)
        if gradient.shape != x.shape:
            raise ValueError(f"gradient must return the shape of x, {x.shape}; {self.name} gave {gradient.shape}")
        return gradient

    def _asked(self, label: str, *arguments: Any) -> Any:
        """What the program answers; what it raises is told as a ValueError."""
        try:
            return getattr(self, label)(*arguments)
        except ValueError:
            raise
        except Exception as error:
            advice = "; where a run fails it must return a state that is not finite" if label == "simulate" else ""
            raise ValueError(f"{label} of {self.name} raised {type(error).__name__}: {error}{advice}") from error

    def weights(self, seed: int = 0) -> Array:
        """w (ny,): an objective w . y that looks at all of the last state."""
        y = self.state(self.x)
        if not np.isfinite(y).all():
            raise ValueError(f"simulate must reach its end at x; {self.name} gave a state that is not finite")
        return np.ones(1) if y.size == 1 else np.random.default_rng(seed).normal(size=y.size)


def _indices(name: str, places: Any, count: int) -> NDArray[np.int64]:
    try:
        return np.atleast_1d(np.arange(count)[places])
    except IndexError as error:
        raise ValueError(f"blocks[{name!r}] must be indices from 0 to {count - 1}; got {places!r:.60}") from error


@dataclass(frozen=True, eq=False)
class Method:
    """A stepper with its system, as a `Simulator` sees it: the two callables.  Planted bugs replace the second."""

    stepper: Stepper
    variables: Variables

    def run(self, x: Array, steps: int, h: float) -> Trajectory:
        """The trajectory from the numbers x."""
        system, y0 = self.variables.place(x)
        return record(self.stepper, system, y0, h, steps)

    def simulate(self, x: Array, steps: int, h: float) -> Array:
        run = self.run(x, steps, h)
        return run.last if run.status is Status.CONVERGED else np.full(run.last.shape, np.nan)

    def gradient(self, x: Array, steps: int, h: float, w: Array) -> Array:
        return self.variables.gather(adjoint(self.run(x, steps, h), w))


def of_system(
    stepper: Stepper, system: Any, y0: Any, run: tuple[float, int], wrt: Iterable[str] | None = None, name: str = ""
) -> Simulator:
    """dsim's own method as a `Simulator`.  run: (h, steps).  wrt: as in `Variables`; all there is by default."""
    names = ["positions", "velocities", *system.split(system.theta)] if wrt is None else wrt
    return of_method(Method(stepper, Variables(system, y0, names)), run, name or type(stepper).__name__)


def of_method(method: Any, run: tuple[float, int], name: str) -> Simulator:
    """A `Simulator` from a `Method` or one like it."""
    variables = method.variables
    return Simulator(
        name, variables.start, method.simulate, method.gradient, *run, variables.split(np.arange(len(variables)))
    )
