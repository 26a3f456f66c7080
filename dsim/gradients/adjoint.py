"""The discrete adjoint.  Lecture: "(Discrete) adjoint method"."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.simulation import Trajectory


@dataclass(frozen=True, eq=False)
class Gradient:
    """dJ/dy0 (ny,) and dJ/dtheta (P,); `gradient["springs.stiffness"]` is the part of one parameter."""

    y0: Array
    theta: Array
    parts: dict[str, Array] = field(repr=False)
    recomputed: int = 0  # steps taken again because their states were not kept

    def __getitem__(self, name: str) -> Array:
        if name not in self.parts:
            known = ", ".join(self.parts)
            raise KeyError(f"no parameter is called {name!r}; this system has {known}; by the start it is .y0")
        return self.parts[name]


Load = Callable[[int, Array], Array | None]  # (n, y_n) -> dJ/dy_n


def adjoint(trajectory: Trajectory, dJdy: Any, dJdtheta: Any = None) -> Gradient:
    """The gradient of J(y_0, ..., y_N, theta) from dJdy (N+1,ny), its derivative by every state; (ny,) for J(y_N).

    dJdy may also be a callable (n, y_n) -> (ny,), asked once for every n from N down to 0: with `Checkpoints` the
    states are seen on the way back only.  dJdtheta: where J depends on the parameters itself, that derivative, (P,)
    or {"springs.stiffness": (E,), ...}.

    mu_N = dJ/dy_N, then backward  mu_n = dJ/dy_n + (dy_{n+1}/dy_n)^T mu_{n+1}: the cost does not depend on the
    number of parameters.  Raises ValueError on a wrong shape, a trajectory without its system, or one that failed.
    """
    _, system = trajectory.differentiable()
    load = _load(dJdy, trajectory)
    again = 0
    if trajectory.snapshots is not None:
        mu, theta_bar, again = trajectory.snapshots.backward(load)
    elif trajectory.run is not None:
        mu, theta_bar = _over_rows(trajectory, load)
    else:
        mu, theta_bar = _over_steps(trajectory, load)
    first = load(0, trajectory.first)
    return gradient_of(system, mu if first is None else mu + first, theta_bar, dJdtheta, again)


def _load(dJdy: Any, trajectory: Trajectory) -> Load:
    """dJ/dy_n on demand, checked."""
    if callable(dJdy):
        size = trajectory.attached()[1].size
        return lambda n, y: as_array(f"dJdy at n = {n}", dJdy(n, y), (size,))
    array, steps = as_loads("dJdy", dJdy, trajectory), len(trajectory.t) - 1
    if array.ndim == 1:
        return lambda n, y: array if n == steps else None
    return lambda n, y: array[n]


def as_loads(name: str, value: Any, trajectory: Trajectory) -> Array:
    """A derivative by every state, (N+1,ny), or by the last alone, (ny,); else ValueError."""
    size = trajectory.attached()[1].size
    loads = as_array(name, value)
    if loads.shape not in ((len(trajectory.t), size), (size,)):
        last = f"({size},) for the last state alone"
        raise ValueError(f"{name} must have shape {(len(trajectory.t), size)}, or {last}; got {loads.shape}")
    return loads


def _over_rows(trajectory: Trajectory, load: Load) -> tuple[Array, Array]:
    """An explicit run on coordinate rows."""
    run: Any = trajectory.run

    def rows(n: int) -> Array | None:
        bar = load(n, run.outward(run.states[n]))
        return None if bar is None else run.rows_of(bar)

    with np.errstate(divide="ignore"):  # 1/l of coincident ends, set to 0 by the springs
        pulled: tuple[Array, Array] = run.pull(rows)
    return pulled


def _over_steps(trajectory: Trajectory, load: Load) -> tuple[Array, Array]:
    """Any stepper, step by step."""
    stepper, system = trajectory.attached()
    mu = np.zeros(stepper.history * system.size)
    theta_bar = np.zeros(system.parameter_count)
    for n in range(len(trajectory.t) - 2, -1, -1):
        if (bar := load(n + 1, trajectory.y[n + 1])) is not None:
            mu[: system.size] += bar
        mu = stepper.linearize(system, trajectory.step(n)).pullback(mu, theta_bar)
    if stepper.history > 1:
        mu = stepper.linearize(system, trajectory.start()).pullback(mu, theta_bar)
    return mu, theta_bar


def gradient_of(system: Any, by_start: Array, by_theta: Array, dJdtheta: Any = None, recomputed: int = 0) -> Gradient:
    """Both derivatives, the second with names and with the explicit part dJ/dtheta added."""
    if dJdtheta is not None:
        by_theta = by_theta + explicit_part(system, dJdtheta)
    return Gradient(by_start, by_theta, system.split(by_theta), recomputed)


def explicit_part(system: Any, dJdtheta: Any) -> Array:
    """dJ/dtheta at fixed states, (P,), from an array or from named parts."""
    total = np.zeros(system.parameter_count)
    if not isinstance(dJdtheta, Mapping):
        return as_array("dJdtheta", dJdtheta, total.shape)
    parts = system.split(total)
    for name, value in dJdtheta.items():
        if name not in parts:
            raise ValueError(f"dJdtheta must name parameters of the system, {', '.join(parts) or 'none'}; got {name!r}")
        parts[name][...] = as_array(f"dJdtheta[{name!r}]", value, parts[name].shape)
    return total
