"""What a scene is: a system, where it starts, and how it is best stepped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, Numbers, as_array, as_count, as_pairs, as_step, check_indices
from dsim.simulation import Trajectory, simulate
from dsim.steppers.stepper import Stepper
from dsim.system import Flow, System


@dataclass(frozen=True, eq=False)
class Scene:
    """A system with an initial state, and the stepper, h and number of steps that suit it.

    summary: one line.  y0 (2n,) = [q, v], or (n,) for a flow.  h s.  exact: t -> y, where a closed form is known.
    edges (E,2): pairs of points to draw, the springs where there are some.  invariants: name -> (t, y) -> number,
    which the true motion keeps constant.  marks (K,d): fixed places worth drawing.

    Of rigid bodies, shapes: of each, its faces, corners (K,3) m in its frame; knots: (which centres (M,), where in
    their frames (M,3)), points on bodies that edges may end at, counted after the centres.  Raises ValueError on bad
    input.
    """

    name: str
    summary: str
    system: System | Flow
    y0: Numbers
    h: float
    steps: int
    stepper: Stepper
    exact: Callable[[float], Array] | None = None
    edges: Numbers = ()
    invariants: Mapping[str, Callable[[float, Array], float]] = field(default_factory=dict)
    marks: Numbers = ()
    shapes: Sequence[Sequence[Array]] = ()
    knots: tuple[Any, Any] = ((), ())

    def __post_init__(self) -> None:
        edges = as_pairs("edges", self.edges)
        to, at = _knots(self.knots, self.points)
        check_indices("edges", edges, self.points + len(to))
        frame: Any = getattr(self.system, "frame", None)
        bodies, particles = (frame.bodies, frame.particles) if frame else (0, self.points)
        if np.any(at[to < particles]) or (len(to) and not frame):
            raise ValueError("knots are places on rigid bodies; particles have no extent")
        shapes = _shapes(self.shapes)
        if len(shapes) not in (0, bodies):
            raise ValueError(f"shapes must be one for each of the {bodies} rigid bodies, or none; got {len(shapes)}")
        values = {
            "shapes": shapes,
            "knots": (to, at),
            "y0": as_array("y0", self.y0, (self.system.size,)),
            "h": as_step(self.h),
            "steps": as_count("steps", self.steps),
            "edges": edges,
            "marks": as_array("marks", np.reshape(self.marks, (-1, self.dimension))),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def dimension(self) -> int:
        """d of the space that the points live in; a flow is one point in the space of its states."""
        return self.system.dimension if isinstance(self.system, System) else self.system.size

    @property
    def points(self) -> int:
        """N; of rigid bodies and what is tied to them, the centres."""
        return len(self.system.mass) if isinstance(self.system, System) else 1

    @property
    def duration(self) -> float:
        """The time of the last state, s."""
        return self.h * self.steps

    def simulate(self, stepper: Stepper | None = None) -> Trajectory:
        """Run it, with the recommended stepper or another one.  Raises SimulationError like `dsim.simulate`."""
        return simulate(stepper or self.stepper, self.system, self.y0, self.h, self.steps)


def _shapes(shapes: Any) -> tuple[tuple[Array, ...], ...]:
    try:
        return tuple(tuple(_face(face) for face in faces) for faces in shapes)
    except TypeError as error:
        raise ValueError(f"shapes must be a list of faces for each body; got {shapes!r:.60}") from error


def _face(corners: Any) -> Array:
    if isinstance(corners, tuple):
        raise ValueError("shapes must be faces without colours, such as dsim.geometry.box_faces([1, 2, 3])")
    face = as_array("a face of shapes", corners, (None, 3))
    if len(face) < 3:
        raise ValueError(f"a face of shapes must have 3 corners or more; got {len(face)}")
    return face


def _knots(knots: Any, centres: int) -> tuple[NDArray[np.int64], Array]:
    try:
        to, at = knots
    except (TypeError, ValueError) as error:
        raise ValueError(f"knots must be (which centres, where in their frames); got {knots!r:.60}") from error
    to, at = np.asarray(to), as_array("knots[1]", at if np.size(at) else np.empty((0, 3)), (None, 3))
    if to.size and not np.issubdtype(to.dtype, np.integer):
        raise ValueError(f"knots[0] must be whole numbers; got {to.dtype}")
    if to.shape != (len(at),) or np.any((to < 0) | (to >= centres)):
        raise ValueError(f"knots[0] must be a centre for each of the {len(at)} places; got {to.tolist()}")
    return to.astype(np.int64), at


def at_rest(x: Array) -> Array:
    """Positions x (N,d) -> the state y = [q, 0]."""
    return np.concatenate([np.ravel(x), np.zeros(x.size)])
