"""The discrete adjoint.  Lecture: "(Discrete) adjoint method"."""

from __future__ import annotations

from collections.abc import Mapping
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

    def __getitem__(self, name: str) -> Array:
        if name not in self.parts:
            raise KeyError(f"no parameter is called {name!r}; this system has {', '.join(self.parts)}")
        return self.parts[name]


def adjoint(trajectory: Trajectory, dJdy: Any, dJdtheta: Any = None) -> Gradient:
    """The gradient of J(y_0, ..., y_N, theta) from dJdy (N+1,ny), its derivative by every state; (ny,) for J(y_N).

    dJdtheta: where J depends on the parameters itself, that derivative, (P,) or {"springs.stiffness": (E,), ...}.

    mu_N = dJ/dy_N, then backward  mu_n = dJ/dy_n + (dy_{n+1}/dy_n)^T mu_{n+1}: the cost does not depend on the
    number of parameters.  Raises ValueError on a wrong shape, a trajectory without its system, or one that failed.
    """
    stepper, system = trajectory.differentiable()
    steps = len(trajectory.t) - 1
    dJdy = as_loads("dJdy", dJdy, trajectory)
    final = dJdy.ndim == 1
    by_first = dJdy if final and steps == 0 else 0.0 if final else dJdy[0]
    if trajectory.run is not None:
        with np.errstate(divide="ignore"):  # 1/l of coincident ends, set to 0 by the springs
            mu, theta_bar = trajectory.run.pull(dJdy)
        return gradient_of(system, mu + by_first, theta_bar, dJdtheta)
    mu = np.zeros(stepper.history * system.size)
    theta_bar = np.zeros(system.parameter_count)
    for n in range(steps - 1, -1, -1):
        if not final or n == steps - 1:
            mu[: system.size] += dJdy if final else dJdy[n + 1]
        mu = stepper.linearize(system, trajectory.step(n)).pullback(mu, theta_bar)
    if stepper.history > 1:
        mu = stepper.linearize(system, trajectory.start()).pullback(mu, theta_bar)
    return gradient_of(system, mu + by_first, theta_bar, dJdtheta)


def as_loads(name: str, value: Any, trajectory: Trajectory) -> Array:
    """A derivative by every state, (N+1,ny), or by the last alone, (ny,); else ValueError."""
    size = trajectory.attached()[1].size
    loads = as_array(name, value)
    if loads.shape not in ((len(trajectory.t), size), (size,)):
        last = f"({size},) for the last state alone"
        raise ValueError(f"{name} must have shape {(len(trajectory.t), size)}, or {last}; got {loads.shape}")
    return loads


def gradient_of(system: Any, by_start: Array, by_theta: Array, dJdtheta: Any = None) -> Gradient:
    """Both derivatives, the second with names and with the explicit part dJ/dtheta added."""
    if dJdtheta is not None:
        by_theta = by_theta + explicit_part(system, dJdtheta)
    return Gradient(by_start, by_theta, system.split(by_theta))


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
