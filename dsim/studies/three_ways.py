"""Three ways to the derivative of a trajectory: one solve with the whole block system, forward sensitivities, and
the adjoint.  Lecture: "What about dynamics?" and "(Discrete) adjoint method"."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Gravity, SpringDamping, Springs
from dsim.gradients import adjoint, block_system, sensitivity
from dsim.simulation import simulate
from dsim.studies.check import Check
from dsim.system import System

H, STEPS = 0.02, 4
BOUND = 1e-12  # round-off of a few solves


def driven_net(steps: int = STEPS, seed: int = 0) -> tuple[System, Array]:
    """Four points in the plane, one pinned, with every kind of parameter; actuation for `steps` steps of H."""
    rng = np.random.default_rng(seed)
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2)]
    effects = (
        Gravity([0.3, -9.81]),
        Drag(rng.uniform(0.1, 0.5, 4), wind=[1.0, -0.5]),
        Springs(pairs, rng.uniform(0.5, 1.2, 4), rng.uniform(20, 60, 4)),
        SpringDamping(pairs, rng.uniform(0.1, 0.6, 4)),
        Actuation(rng.normal(size=(steps, 4, 2)), h=H),
    )
    system = System(rng.uniform(0.5, 2.0, 4), effects, dimension=2, fixed=[0])
    return system, np.concatenate([rng.normal(size=8), 0.3 * rng.normal(size=8)])


def kinds(system: Any) -> dict[str, Array]:
    """Where each kind of parameter lies in p = (y0, theta): "start", "mass", "springs.stiffness", ..."""
    ny = system.size
    parts = system.split(np.arange(ny, ny + system.parameter_count))
    return {"start": np.arange(ny)} | {name: part.ravel() for name, part in parts.items()}


def three_ways(stepper: Any, steps: int = STEPS, seed: int = 0) -> tuple[Check, ...]:
    """Differences between the three ways on `driven_net`, a check a kind of parameter.

    The Jacobians of all states, and the gradient of an objective that weighs all of them and depends on the parameters
    itself; each relative to the largest entry of that kind.  A kind that changes nothing is no evidence: it fails.
    """
    system, y0 = driven_net(steps, seed)
    trajectory = simulate(stepper, system, y0, H, steps)
    rng, ny, count = np.random.default_rng(seed + 1), system.size, system.parameter_count
    weights, explicit = rng.normal(size=(steps + 1, ny)), rng.normal(size=count)
    own = np.concatenate([np.zeros(ny), explicit])
    whole = block_system(trajectory)
    monolithic = whole.derivative()
    forward = sensitivity(trajectory, *np.split(np.eye(ny + count), [ny]))
    gradient = adjoint(trajectory, weights, explicit)
    gradients = (
        np.einsum("ni,nip->p", weights, monolithic) + own,
        np.einsum("ni,nip->p", weights, forward) + own,
        np.concatenate([gradient.y0, gradient.theta]),
        whole.gradient(weights) + own,
    )
    checks = []
    for name, places in kinds(system).items():
        apart = max(
            _apart(monolithic[..., places], forward[..., places]),
            *(_apart(gradients[0][places], other[places]) for other in gradients[1:]),
        )
        statement = f"three ways to the derivative by {name}"
        checks.append(Check(type(stepper).__name__, statement, bool(apart <= BOUND), apart, f"<= {BOUND:.0e}"))
    return tuple(checks)


def _apart(one: Array, other: Array) -> float:
    """Largest difference relative to the largest entry; NaN where all are zero."""
    scale = np.abs(one).max()
    return float(np.abs(one - other).max() / scale) if scale > 0 else float("nan")
