"""Everything dsim offers, as explicit tuples.  One row here, and the generated checks run on it.

A new kernel, effect, stepper or scene that is not listed fails `tests/test_catalog.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim import scenes
from dsim.arrays.checks import Array
from dsim.effects import (
    Actuation,
    AngularDrag,
    Attached,
    Drag,
    Field,
    Gravity,
    SpringDamping,
    Springs,
    TorqueActuation,
)
from dsim.kernels import SPRING, Kernel
from dsim.pictures import formwork as fabrics
from dsim.pictures import rigid as turning
from dsim.pictures import showcases as drawn
from dsim.steppers import (
    BDF2,
    RK4,
    RKMK4,
    BackwardEuler,
    ForwardEuler,
    ImplicitMidpoint,
    NormalisedEuler,
    RuleStepper,
    SymplecticEuler,
    Trapezoidal,
    TwoStepBackwardEuler,
    VelocityVerlet,
)
from dsim.studies import body_problems, hard_cases, planted, problems
from dsim.studies.answers import formulas, motions, programs
from dsim.studies.answers.document import Item
from dsim.studies.bodies import BodyEffectExample, corners, tumbling_in_wind
from dsim.studies.convergence import OrderProblem, leaf_in_river, pendulum_in_wind
from dsim.studies.derivatives import EffectExample
from dsim.studies.hard_cases import HardCase
from dsim.studies.reference import DOP853, LSODA, RADAU, Reference
from dsim.studies.showcases import control, formwork, identification, racket, targeting, tumbling
from dsim.studies.showcases.model import Showcase


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


def _tied(rng: np.random.Generator, bodies: int, effect: Any) -> Attached:
    return Attached(effect, *corners(rng, bodies))


BODY_EFFECTS: tuple[BodyEffectExample, ...] = (
    BodyEffectExample("gyroscopic", lambda rng, b: None),
    BodyEffectExample("gravity", lambda rng, b: Gravity(rng.normal(size=3))),
    BodyEffectExample("drag", lambda rng, b: Drag(rng.uniform(0.1, 2.0, b), wind=rng.normal(size=3))),
    BodyEffectExample("springs between centres", lambda rng, b: Springs([(0, 1), (1, 2)], 0.7, rng.uniform(1, 9, 2))),
    BodyEffectExample("angular drag", lambda rng, b: AngularDrag(0.7)),
    BodyEffectExample("angular drag per body", lambda rng, b: AngularDrag(rng.uniform(0.1, 2.0, b))),
    BodyEffectExample("torque", lambda rng, b: TorqueActuation(rng.normal(size=(3, b, 3)), h=0.02)),
    BodyEffectExample("torque, body", lambda rng, b: TorqueActuation(rng.normal(size=(3, b, 3)), 0.02, "body")),
    BodyEffectExample("springs at corners", lambda rng, b: _tied(rng, b, Springs([(0, 1), (2, 3)], 0.5, [4.0, 7.0]))),
    BodyEffectExample("damping at corners", lambda rng, b: _tied(rng, b, SpringDamping([(0, 1), (2, 3)], [1.0, 2.0]))),
    BodyEffectExample("drag at corners", lambda rng, b: _tied(rng, b, Drag(0.7, wind=rng.normal(size=3)))),
    BodyEffectExample("field at corners", lambda rng, b: _tied(rng, b, Field(_bowl, _bowl_jacobian, _bowl_potential))),
    BodyEffectExample("forces at corners", lambda rng, b: _tied(rng, b, Actuation(rng.normal(size=(3, 4, 3)), h=0.02))),
)

# What turns bodies: one-step methods, with a map of rotations each.
BODY_STEPPERS: tuple[RuleStepper, ...] = (
    ForwardEuler(),
    SymplecticEuler(),
    NormalisedEuler(),
    BackwardEuler(),
    ImplicitMidpoint(),
    Trapezoidal(),
    VelocityVerlet(),
    RK4(),
    RKMK4(),
)

BODY_ORDER_PROBLEMS: tuple[Callable[[], OrderProblem], ...] = (tumbling_in_wind,)

ORDER_PROBLEMS: tuple[Callable[[], OrderProblem], ...] = (pendulum_in_wind, leaf_in_river)

REFERENCES: tuple[Reference, ...] = (DOP853, RADAU, LSODA)

PROBLEMS: tuple[Callable[[], problems.Problem], ...] = (
    problems.projectile,
    problems.pendulum,
    problems.kepler,
    problems.chain,
    problems.two_rates,
    problems.cloth,
    body_problems.free_top,
    body_problems.heavy_top,
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
    scenes.racket,
    scenes.sign,
)

SHOWCASES: tuple[Showcase, ...] = (
    Showcase(
        "control",
        "a soft trunk writes a circle: the rest length of every muscle in every step",
        control.run,
        drawn.control,
    ),
    Showcase(
        "identification",
        "the stiffness of every spring from a film of its points, with error bars that hold",
        identification.run,
        drawn.identification,
    ),
    Showcase(
        "targeting",
        "a net thrown through drag and gusts hits a frame flat: its velocity and spin",
        targeting.run,
        drawn.targeting,
    ),
    Showcase(
        "formwork",
        "a fabric under wet concrete hangs in a wanted shape: rest lengths and stiffnesses",
        formwork.run,
        fabrics.before_after,
    ),
    Showcase(
        "racket",
        "a racket thrown up comes back face up: the spin with which it leaves the hand",
        racket.run,
        turning.caught,
    ),
    Showcase(
        "tumbling",
        "the inertia of a body from a film of its tumbling, with error bars that hold",
        tumbling.run,
        turning.weighed,
    ),
)

HARD_CASES: tuple[HardCase, ...] = (
    HardCase(
        1,
        "a very stiff spring",
        "k = 1e8 N/m, m = 1 kg, h = 0.01 s",
        "the motion is bounded; backward Euler multiplies the energy by 1/(1 + h^2 w^2) each step",
        hard_cases.stiff_spring,
    ),
    HardCase(
        2,
        "the edge of stability",
        "symplectic Euler at h w = 1.99 and 2.01, 1e4 steps from x = 1 at rest",
        "|x| <= 1/sqrt(1 - (h w/2)^2) = 10.0125 at 1.99, and no bound from 2 on",
        hard_cases.edge_of_stability,
    ),
    HardCase(
        3,
        "coincident ends",
        "a spring with l0 = 1 m whose ends are in one place",
        "the force has no direction: 0/0, so it must be documented, here f = 0",
        hard_cases.coincident_ends,
    ),
    HardCase(
        4,
        "a compressed spring",
        "a loaded 2-D spring at l = l0/2, one end fixed, a backward Euler step with h^2 k/m = 4",
        "K has the eigenvalues k and -k: the matrix of the step is indefinite",
        hard_cases.compressed_spring,
    ),
    HardCase(
        5,
        "Newton overshoots",
        "minimise sqrt(1 + x^2) from 1, 1.1 and 100",
        "the minimum is at 0; Newton's step is x -> -x^3",
        hard_cases.overshooting_newton,
    ),
    HardCase(
        6,
        "a truss that snaps through",
        "von Mises' truss: half-width 1 m, rise 0.5 m, k = 1 N/m a bar, loaded up to its fold",
        "Pc = 2k(l0^(2/3) - 1)^(3/2) = 0.0429143257 N at the height 0.277880 m; dy/dP ~ (1 - P/Pc)^(-1/2)",
        hard_cases.von_mises_truss,
    ),
    HardCase(
        7,
        "an upright strut",
        "a strut on a hinge under a load P L/kappa = 1.1, started upright",
        "upright is unstable; it leans at theta/sin(theta) = 1.1, theta = 0.74898664",
        hard_cases.hinged_strut,
    ),
    HardCase(
        8,
        "a planet's orbit",
        "Kepler with e = 0.6 from the pericentre, 1000 steps a period (20 periods unless in full)",
        "energy and angular momentum are constant",
        hard_cases.orbit,
    ),
    HardCase(
        9,
        "momenta of a free net",
        "a free spring net under internal central forces, 1e4 steps",
        "linear and angular momentum are constant",
        hard_cases.free_net,
    ),
    HardCase(
        10,
        "a racket that flips",
        "I = (1, 2, 3), w = (0.01, 1, 0.01) rad/s; midpoint with h = 0.04 s (0.01 in full)",
        "w2 changes its sign every 19.5528671 s, first after 10.9169 s; E and L are constant",
        hard_cases.racket,
    ),
    HardCase(
        11,
        "a fast wobble",
        "I = (1, 1.2, 2), w = (5, 1, 100) rad/s, h = 1/60 s",
        "E and L are constant, the wobble goes on",
        hard_cases.fast_wobble,
    ),
    HardCase(
        12,
        "a heavy top",
        "I1 = 1, I3 = 0.5 kg m^2 about the tip, m g l = 1 N m, 30 degrees, w3 = 20 rad/s, 20 s",
        "steady precession 0.1008813582 rad/s; let go it nods to 0.5338654 rad; it sleeps upright above w3 = 4",
        hard_cases.spinning_top,
    ),
    HardCase(
        13,
        "quaternions that are only added to",
        "w = 10 rad/s, h = 0.01 s, 1000 steps of q + h qdot",
        "the norm is 1, the angle 100 rad",
        hard_cases.added_quaternions,
    ),
    HardCase(
        41,
        "chaos",
        "the logistic map x -> 4 x (1 - x) from sin^2(0.3)",
        "x_n = sin^2(2^n 0.3), so dx_n/dx_0 = 2^n sin(2^(n+1) 0.3)/sin(0.6)",
        hard_cases.chaotic_map,
    ),
    HardCase(
        45,
        "the norm at zero; checkpoints",
        "gradients through |x| where x = 0, alone and inside a simulation; 1001 steps with 10 states kept",
        "|x| has a kink there: 0 is a subgradient, nothing may become NaN; the full tape's gradient, bit by bit",
        hard_cases.norm_at_zero,
    ),
)

PLANTED: tuple[planted.PlantedBug, ...] = planted.bugs()

ANSWERS: tuple[Item, ...] = (*programs.items(STEPPERS), *motions.items(PROBLEMS), *formulas.items())
