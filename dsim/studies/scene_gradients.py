"""The gradient of a scene, judged like anybody else's: by `check_gradient`, one number for each kind of parameter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.gradients import adjoint
from dsim.simulation import simulate
from dsim.studies.gradient_check import GradientReport, check_gradient


def knobs(system: Any) -> tuple[str, ...]:
    """What is turned: every named parameter as a whole, the start's positions and velocities along one direction."""
    return (*system.split(np.zeros(system.parameter_count)), "positions", "velocities")


def objective(scene: Any, steps: int, seed: int = 0) -> Callable[[Array], tuple[float, Array]]:
    """z -> (J, dJ/dz) by simulation and adjoint, z one number a knob.

    A knob scales its parameter by 1 + z, or moves the start by z along a random direction.  J weighs
    all states with random numbers and adds half their squares, so that no entry of y is left out.
    """
    system, y0 = scene.system, np.asarray(scene.y0, dtype=float)
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(steps + 1, system.size)) / np.sqrt(steps * system.size)
    parts = system.split(np.arange(system.parameter_count))
    directions = np.zeros((2, system.size))
    directions[0, : system.width] = 0.01 * rng.normal(size=system.width)
    if system.components == 2:
        directions[1, system.width :] = 0.01 * rng.normal(size=system.n)

    def evaluate(z: Array) -> tuple[float, Array]:
        theta = system.theta.copy()
        for knob, places in zip(z, parts.values(), strict=False):
            theta[places.astype(int)] *= 1 + knob
        there = system.with_theta(theta) if theta.size else system
        start = y0 + z[-2:] @ directions
        trajectory = simulate(scene.stepper, there, start, scene.h, steps)
        value = float((weights * trajectory.y).sum() + 0.5 * ((weights * trajectory.y) ** 2).sum())
        if not wanted[0]:
            return value, z
        gradient = adjoint(trajectory, weights + weights**2 * trajectory.y)
        by_knob = [gradient.theta[p.astype(int)].ravel() @ system.theta[p.astype(int)].ravel() for p in parts.values()]
        return value, np.array([*by_knob, *(directions @ gradient.y0)])

    wanted = [True]  # the gradient is wanted once; the differences need values alone

    def once(z: Array) -> tuple[float, Array]:
        answer = evaluate(z)
        wanted[0] = False
        return answer

    return once


def check_scene(scene: Any, steps: int = 2, seed: int = 0) -> GradientReport:
    """The adjoint of `steps` steps of a scene with its own stepper, judged by differences of the simulation."""
    count = len(knobs(scene.system)) if scene.system.components == 2 else 2
    return check_gradient(objective(scene, steps, seed), np.zeros(count))
