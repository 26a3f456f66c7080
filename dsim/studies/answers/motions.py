"""Continuous problems: the true motion, and the true gradient of an objective at its end.

A method meets them only as h falls; how fast is its order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from dsim.arrays.checks import Array
from dsim.studies.answers.document import (
    SI,
    Document,
    Item,
    certified,
    equations,
    evidence,
    header,
    objective,
    system_data,
    value_of,
)
from dsim.studies.problems import Problem, adjoint_equation, solution
from dsim.studies.reference import DOP853

TIMES = 12
TOLERANCE = (1e-9, 1e-8)  # what an integrator that knows no closed form confirms
DESCRIPTIONS = {
    "projectile": "A ball with linear drag",
    "pendulum": "A rigid pendulum released at 2 rad: Jacobi's elliptic functions",
    "kepler": "A planet on an ellipse of eccentricity 0.6, for 1.16 periods",
    "chain": "Six points on a line between two walls: all six normal modes at once",
    "two-rates": "Two points on a line, a slow and a fast mode: stiff",
    "cloth": "A cloth of 8 x 8 points pinned at two corners falls",
}


def items(builders: Sequence[Callable[[], Problem]]) -> list[Item]:
    """Every problem of the catalog."""
    return [item(build()) for build in builders]


def item(problem: Problem) -> Item:
    """One problem."""
    first, second = problem.references
    source = f"{first.method} and {second.method}" if problem.exact is None else f"closed form, {DOP853.method}"
    duration = f"{problem.duration:g} s"
    return Item(problem.name, problem.system.size, 0, duration, TOLERANCE, source, partial(document, problem))


def document(problem: Problem) -> Document:
    """States at 12 times, J and dJ/dy0, and how well two unrelated routes agree on them."""
    truth = problem.truths[0]
    times = problem.duration * np.arange(1, TIMES + 1) / TIMES
    states = np.stack([truth.states(float(t)) for t in times])
    weight = np.tile(problem.system.free, 2) / problem.scale
    linear, quadratic = weight * problem.weights, weight**2  # J = w . z + z . z / 2, z = y / scale where y is free
    goal = objective([TIMES - 1], linear[None], quadratic[None])
    numbers = system_data(problem.system)
    found = header(problem.name, "motion", DESCRIPTIONS[problem.name], SI)
    found |= {
        "equations": equations(numbers),
        "system": numbers,
        "y0": problem.y0,
        "time": {"duration": problem.duration},
        "objective": goal,
        "answer": {
            "t": times,
            "states": states,
            "value": value_of(goal, states),
            "gradient": {"y0": truth.gradient},
        },
        "scale": problem.scale,
        "certificate": _certificate(problem, times, states, truth.gradient),
        "tolerance": {"states": np.full(TIMES, TOLERANCE[0]), "gradient": TOLERANCE[1]},
    }
    return certified(found)


def _certificate(problem: Problem, times: Array, states: Array, gradient: Array) -> Document:
    """A closed form against DOP853, or two integrators against each other; scaled, the gradient relative."""
    first, second = (reference.name for reference in problem.references)
    apart, gradients_apart = f"{first} against {second}", f"the adjoint equation by {first} against {second}"
    state_gap, gradient_gap = problem.certificate, problem.gradient_certificate
    if problem.exact is not None:
        integrated = solution(problem, DOP853)
        other = np.stack([integrated(float(t)) for t in times])
        apart, state_gap = f"closed form against {DOP853.name}", float(np.abs((states - other) / problem.scale).max())
    if problem.transposed_flow is not None:
        by_adjoint = adjoint_equation(problem, DOP853, states[-1])
        gradients_apart = f"closed form against the adjoint equation by {DOP853.name}"
        gradient_gap = problem.gradient_error(by_adjoint, gradient)
    return {"states": [evidence(apart, state_gap)], "gradient": [evidence(gradients_apart, gradient_gap)]}
