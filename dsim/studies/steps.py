"""Generated checks of steppers: the residual, its linearization, and the fast path against the definition."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Field, Gravity, SpringDamping, Springs
from dsim.steppers.stepper import Step
from dsim.studies.check import Check
from dsim.studies.derivatives import deviation, directional, verdict
from dsim.system import Flow, System


@dataclass(frozen=True, eq=False)
class StepProblem:
    """A step to be linearized: an ode, a state y0 and a step size."""

    name: str
    system: System | Flow
    y0: Array
    h: float


def everything(dimension: int = 2, seed: int = 0) -> StepProblem:
    """A pinned spring net under every effect of the library at once, far from equilibrium."""
    rng = np.random.default_rng(seed)
    points, h = 4, 0.05
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]

    def swirl(t: float, x: Array) -> Array:
        return np.roll(np.sin(x + t), 1, axis=1)

    effects = (
        Gravity(rng.normal(size=dimension)),
        Drag(rng.uniform(0.1, 1.0, points), wind=swirl),
        Field(lambda x: -(x**3), lambda x: np.einsum("ni,ij->nij", -3 * x**2, np.eye(dimension))),
        Springs(pairs, rng.uniform(0.5, 2.0, 5), rng.uniform(5.0, 40.0, 5)),
        SpringDamping(pairs, rng.uniform(0.1, 0.8, 5)),
        Actuation(rng.normal(size=(2, points, dimension)), h),
    )
    system = System(rng.uniform(0.5, 2.0, points), effects, dimension, fixed=(1,))
    return StepProblem(f"all effects {dimension}-D", system, rng.normal(size=system.size), h)


def river() -> StepProblem:
    """A leaf in a swirling, pulsating river: a first-order flow without a Jacobian symmetry."""

    def phi(t: float, y: Array) -> Array:
        return np.array([np.cos(t) - y[1] + 0.3 * y[0] * y[1], y[0] + 0.5 * np.sin(y[1])])

    def slope(t: float, y: Array) -> Array:
        return np.array([[0.3 * y[1], -1 + 0.3 * y[0]], [1.0, 0.5 * np.cos(y[1])]])

    return StepProblem("flow", Flow(phi, size=2, jacobian=slope), np.array([0.7, -0.4]), 0.1)


def check_stepper(stepper: Any, problem: StepProblem, seed: int = 0) -> tuple[Check, ...]:
    """Residual, A, B, C, tangent, pullback and Taylor remainder of one step (and of the start, if it has a past)."""
    ode, y0, h = problem.system, problem.y0, problem.h
    subject = f"{type(stepper).__name__}, {problem.name}"
    start = stepper.start(ode, 0.0, y0, h)
    checks = list(_step_checks(stepper, ode, stepper.step(ode, 0.0, start.y1, h), subject, seed))
    if stepper.history > 1:
        checks += _linear_checks(stepper, ode, start, f"{subject}, start", seed)
    return tuple(checks)


def _step_checks(stepper: Any, ode: Any, step: Step, subject: str, seed: int) -> Iterator[Check]:
    yield verdict(subject, "residual of a solved step", float(np.abs(stepper.residual(ode, step)).max()), 1e-10)
    linear = stepper.linearize(ode, step)

    def residual(**changes: Any) -> Array:
        at: Array = stepper.residual(ode, replace(step, **changes))
        return at

    rng = np.random.default_rng(seed)
    u, w = (rng.normal(size=(size, 3)) for size in (step.y0.size, ode.parameter_count))
    by_y1 = directional(lambda y1: residual(y1=y1), step.y1, u)
    by_y0 = directional(lambda y0: residual(y0=y0), step.y0, u)
    yield verdict(subject, "A = dR/dy1", deviation(linear.A @ u, by_y1))
    yield verdict(subject, "B = dR/dy0", deviation(linear.B @ u, by_y0))
    if ode.parameter_count:
        by_theta = directional(lambda p: stepper.residual(ode.with_theta(p), step), ode.theta, w)
        yield verdict(subject, "C = dR/dtheta", deviation(linear.C @ w, by_theta))
    yield from _linear_checks(stepper, ode, step, subject, seed)
    yield _taylor_check(stepper, ode, step, subject, seed)
    yield _second_order_check(stepper, ode, step, subject, seed)


def _second_order_check(stepper: Any, ode: Any, step: Step, subject: str, seed: int) -> Check:
    """The derivative of mu -> pullback(mu) along a random change of mu, y0 and theta, against differences of it."""
    rng = np.random.default_rng(seed + 2)
    sizes = (step.y1.size, step.y0.size, ode.parameter_count)
    mu, (dmu, dy0, dtheta) = rng.normal(size=sizes[0]), (rng.normal(size=size) for size in sizes)

    def pullback(s: Array) -> Array:
        moved = ode.with_theta(ode.theta + s * dtheta) if ode.parameter_count else ode
        there = stepper.step(moved, step.t, step.y0 + s * dy0, step.h)
        theta_bar = np.zeros(ode.parameter_count)
        return np.append(stepper.linearize(moved, there).pullback(mu + s * dmu, theta_bar), theta_bar)

    measured = directional(pullback, np.zeros(1), np.ones((1, 1)))[:, 0]
    linear, bars = stepper.linearize(ode, step), (np.zeros(sizes[2]), np.zeros(sizes[2]))
    changes = linear.push(dy0, dtheta)[1]
    turned = linear.pullback_tangent(np.stack([mu, dmu], axis=1), changes, dtheta, bars)[:, 1]
    return verdict(subject, "pullback_tangent = d pullback", deviation(np.append(turned, bars[1]), measured))


def _linear_checks(stepper: Any, ode: Any, step: Step, subject: str, seed: int) -> Iterator[Check]:
    """Tangent against -A^-1 (B dy0 + C dtheta), and the dot product that ties the pullback to the tangent."""
    rng = np.random.default_rng(seed)
    dy0, dtheta, mu = (rng.normal(size=n) for n in (step.y0.size, ode.parameter_count, step.y1.size))
    linear = stepper.linearize(ode, step)
    tangent = linear.tangent(dy0, dtheta)
    plain = -np.linalg.solve(linear.A.toarray(), linear.B @ dy0 + linear.C @ dtheta)
    yield verdict(subject, "tangent = -A^-1 (B dy0 + C dtheta)", deviation(tangent, plain), 1e-11)
    theta_bar = np.zeros(ode.parameter_count)
    pullback = linear.pullback(mu, theta_bar)
    forward, backward = mu @ tangent, pullback @ dy0 + theta_bar @ dtheta
    yield verdict(subject, "pullback = tangent transposed", abs(forward - backward) / (1 + abs(forward)), 1e-11)
    bare = replace(step, rates=None)
    again = stepper.linearize(ode, bare).tangent(dy0, dtheta)
    yield verdict(subject, "linearized from states alone", deviation(again, tangent), 1e-9)


def _taylor_check(stepper: Any, ode: Any, step: Step, subject: str, seed: int) -> Check:
    """|y1(y0 + s u, theta + s w) - y1 - s dy1| = O(s^2): the slope over s = 2^-2 ... 2^-9 of a small direction."""
    rng = np.random.default_rng(seed + 1)
    u, w = 0.1 * rng.normal(size=step.y0.size), 0.1 * rng.normal(size=ode.parameter_count)
    tangent = stepper.linearize(ode, step).tangent(u, w)
    scales, remainders = 2.0 ** -np.arange(2, 10), []
    for s in scales:
        moved = ode.with_theta(ode.theta + s * w) if ode.parameter_count else ode
        there = stepper.step(moved, step.t, step.y0 + s * u, step.h).y1
        remainders.append(np.abs(there - step.y1 - s * tangent).max())
    slope = float(np.polyfit(np.log(scales), np.log(remainders), 1)[0])
    return Check(subject, "Taylor remainder slope", bool(abs(slope - 2) <= 0.1), slope, "2 +- 0.1")
