"""Everything dsim offers, as explicit tuples.  One row here, and the generated checks run on it.

A new kernel, effect, stepper or scene that is not listed fails `tests/test_catalog.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim import scenes
from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.kernels import SPRING, Kernel
from dsim.steppers import (
    BDF2,
    RK4,
    BackwardEuler,
    ForwardEuler,
    ImplicitMidpoint,
    RuleStepper,
    SymplecticEuler,
    Trapezoidal,
    TwoStepBackwardEuler,
    VelocityVerlet,
)
from dsim.studies import problems
from dsim.studies.convergence import OrderProblem, leaf_in_river, pendulum_in_wind
from dsim.studies.derivatives import EffectExample
from dsim.studies.reference import DOP853, RADAU, Reference


def _ring(points: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % points) for i in range(points)] + [(0, 2)]


def _breeze(t: float, x: Array) -> Array:
    return np.roll(np.sin(x + t), 1, axis=1)


def _breeze_jacobian(t: float, x: Array) -> Array:
    d = x.shape[1]
    return np.einsum("nj,ij->nij", np.cos(x + t), np.roll(np.eye(d), 1, axis=0))


def _saddle(x: Array) -> Array:
    return np.roll(x, 1, axis=1) ** 2 - x


def _saddle_jacobian(x: Array) -> Array:
    d = x.shape[1]
    return np.einsum("nj,ij->nij", 2 * x, np.roll(np.eye(d), 1, axis=0)) - np.eye(d)


def _bowl(x: Array) -> Array:
    return -x - x**3


def _bowl_jacobian(x: Array) -> Array:
    return np.einsum("ni,ij->nij", -1 - 3 * x**2, np.eye(x.shape[1]))


def _bowl_potential(x: Array) -> Array:
    return (x**2 / 2 + x**4 / 4).sum(axis=1)


def _springs(rng: np.random.Generator, points: int, d: int) -> Springs:
    return Springs(_ring(points), rng.uniform(0.5, 2.0, points + 1), rng.uniform(1.0, 9.0, points + 1))


def _damping(rng: np.random.Generator, points: int, d: int) -> SpringDamping:
    return SpringDamping(_ring(points), rng.uniform(0.1, 2.0, points + 1))


KERNELS: tuple[Kernel, ...] = (SPRING,)

EFFECTS: tuple[EffectExample, ...] = (
    EffectExample("gravity", lambda rng, n, d: Gravity(rng.normal(size=d))),
    EffectExample("drag", lambda rng, n, d: Drag(0.7)),
    EffectExample("drag per point", lambda rng, n, d: Drag(rng.uniform(0.1, 2.0, n), wind=rng.normal(size=d))),
    EffectExample("drag, wind of place", lambda rng, n, d: Drag(0.7, _breeze, _breeze_jacobian)),
    EffectExample("drag, wind differenced", lambda rng, n, d: Drag(rng.uniform(0.1, 2.0, n), _breeze)),
    EffectExample("field", lambda rng, n, d: Field(_saddle, _saddle_jacobian)),
    EffectExample("field, differenced", lambda rng, n, d: Field(_saddle)),
    EffectExample("field, potential", lambda rng, n, d: Field(_bowl, _bowl_jacobian, _bowl_potential)),
    EffectExample("springs", _springs),
    EffectExample("spring damping", _damping),
    EffectExample("actuation", lambda rng, n, d: Actuation(rng.normal(size=(3, n, d)), h=0.02)),
)

STEPPERS: tuple[RuleStepper, ...] = (
    ForwardEuler(),
    SymplecticEuler(),
    BackwardEuler(),
    TwoStepBackwardEuler(),
    ImplicitMidpoint(),
    Trapezoidal(),
    BDF2(),
    VelocityVerlet(),
    RK4(),
)

ORDER_PROBLEMS: tuple[Callable[[], OrderProblem], ...] = (pendulum_in_wind, leaf_in_river)

REFERENCES: tuple[Reference, ...] = (DOP853, RADAU)

PROBLEMS: tuple[Callable[[], problems.Problem], ...] = (
    problems.projectile,
    problems.pendulum,
    problems.kepler,
    problems.chain,
    problems.two_rates,
    problems.cloth,
)

SCENES: tuple[Callable[..., Any], ...] = (
    scenes.projectile,
    scenes.pendulum_stiff,
    scenes.pendulum_spring,
    scenes.chain,
    scenes.cloth,
    scenes.soft_body,
    scenes.kepler,
    scenes.robot,
    scenes.river,
)
