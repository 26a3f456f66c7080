"""Forward sensitivities: the change of every state with the start and the parameters, step by step.

Lecture: "What about dynamics?".  One solve a step and a column, so for few parameters, or for Jacobians; the adjoint
is for gradients by many.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.simulation import Trajectory


def sensitivity(trajectory: Trajectory, dy0: Any = None, dtheta: Any = None) -> Array:
    """dy_n for all n, (N+1,ny), from a change dy0 (ny,) of the start and dtheta (P,) of the parameters.

    Columns (ny,k) and (P,k) give (N+1,ny,k): with identity matrices, the Jacobians of all states.  None counts as 0.
    Raises ValueError on wrong shapes, on a trajectory without its system, and on one that failed.
    """
    return np.stack(list(sensitivities(trajectory, dy0, dtheta)))


def sensitivities(trajectory: Trajectory, dy0: Any = None, dtheta: Any = None) -> Iterator[Array]:
    """`sensitivity`, one state after the other: memory for one (ny,k) instead of all N+1."""
    stepper, system = trajectory.differentiable()
    change, by_theta = as_changes(system, dy0, dtheta)
    yield change
    if stepper.history > 1:
        change = stepper.linearize(system, trajectory.start()).tangent(change, by_theta)
    for n in range(len(trajectory.t) - 1):
        change = stepper.linearize(system, trajectory.step(n)).tangent(change, by_theta)
        yield change[: system.size]


def as_changes(system: Any, dy0: Any, dtheta: Any) -> tuple[Array, Array]:
    """Both changes as floats with the same number of columns, what is missing as zeros."""
    given = {"dy0": (dy0, system.size), "dtheta": (dtheta, system.parameter_count)}
    changes = {name: as_array(name, value) for name, (value, _) in given.items() if value is not None}
    columns = {change.shape[1:] for change in changes.values()}
    if len(columns) > 1:
        raise ValueError(f"dy0 and dtheta must have as many columns; got shapes {changes['dy0'].shape}"
                         f" and {changes['dtheta'].shape}")  # fmt: skip
    shape = columns.pop() if columns else ()
    for name, change in changes.items():
        size = given[name][1]
        if len(shape) > 1 or change.shape != (size, *shape):
            raise ValueError(f"{name} must have shape ({size},) or ({size}, k); got {change.shape}")
    dy0, dtheta = (changes.get(name, np.zeros((size, *shape))) for name, (_, size) in given.items())
    return dy0, dtheta
