"""What a stepper's formula says about coefficients, read off the formula itself.

A rule such as  `y[0] + h * phi(t + h, y[1])`  is affine in the states and in the rates it asks for.
Evaluated on symbols instead of arrays, it yields its own coefficients: they are stated nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array

# ("y", offset, component): a block of the state y_{n+offset};  ("k", s, 0): the rate of stage s.
Symbol = tuple[str, int, int]
Coefficients = dict[Symbol, float]


class Form:
    """A tuple of affine forms - one for q, v or a rate; two for a state (q, v) - with the arithmetic of arrays."""

    __array_ufunc__ = None  # numpy scalars on the left defer to __rmul__

    def __init__(self, *parts: Coefficients) -> None:
        self.parts = parts

    def __add__(self, other: Form) -> Form:
        if not isinstance(other, Form) or len(self.parts) != len(other.parts):
            raise TypeError("a rule may only add states to states and rates to rates")
        return Form(*(_sum((a, 1.0), (b, 1.0)) for a, b in zip(self.parts, other.parts, strict=True)))

    def __mul__(self, factor: float) -> Form:
        return Form(*({s: factor * c for s, c in part.items()} for part in self.parts))

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> Form:
        return self * (1.0 / divisor)

    def __neg__(self) -> Form:
        return self * -1.0

    def __sub__(self, other: Form) -> Form:
        return self + -other


def _sum(*weighted: tuple[Mapping[Symbol, float], float]) -> Coefficients:
    total: Coefficients = {}
    for part, weight in weighted:
        for symbol, coefficient in part.items():
            total[symbol] = total.get(symbol, 0.0) + weight * coefficient
    return {symbol: c for symbol, c in total.items() if c != 0.0}


@dataclass(frozen=True)
class Stage:
    """One rate evaluation: k = rate(t + offset, *arguments)."""

    offset: float
    arguments: tuple[Coefficients, ...]


@dataclass(frozen=True)
class Tableau:
    """The stages of a rule in their order, and the new state as forms in states and rates."""

    stages: tuple[Stage, ...]
    outcome: tuple[Coefficients, ...]


def record(rule: Callable[..., Any], order: int, components: int, h: float) -> Tableau:
    """Evaluate a rule on symbols.  order 1: rule(y, phi, t, h); order 2: rule(q, v, a, t, h)."""
    stages: list[Stage] = []

    def rate(t: float, *arguments: Form) -> Form:
        parts = tuple(part for form in arguments for part in form.parts)
        stages.append(Stage(t, parts))
        k: Coefficients = {("k", len(stages) - 1, 0): 1.0}
        # the reduction to first order, (q, v)' = (v, a), where a state has two blocks
        return Form(parts[1], k) if order == 1 and components == 2 else Form(k)

    blocks = [{n: Form({("y", n, c): 1.0}) for n in (-1, 0, 1)} for c in range(components)]
    if order == 2:
        outcome = rule(*blocks, rate, 0.0, h)
        return Tableau(tuple(stages), tuple(form.parts[0] for form in outcome))
    states = {n: Form(*(block[n].parts[0] for block in blocks)) for n in (-1, 0, 1)}
    parts = rule(states, rate, 0.0, h).parts
    return Tableau(tuple(stages), parts)


def eliminate(tableau: Tableau) -> Tableau:
    """Replace y_{n+1} by what the rule says it is, leaving past states and rates.

    For backward Euler, q1 = q0 + h v1 and v1 = v0 + h k turn the stage (q1, v1) into (q0 + h v0 + h^2 k, v0 + h k):
    the elimination of positions that leads to M - h D - h^2 K.
    """
    components = len(tableau.outcome)
    new = [("y", 1, c) for c in range(components)]
    feedback = np.array([[part.get(symbol, 0.0) for symbol in new] for part in tableau.outcome])
    known = [{s: c for s, c in part.items() if s not in new} for part in tableau.outcome]
    inverse = np.linalg.inv(np.eye(components) - feedback)
    outcome = tuple(_sum(*zip(known, row, strict=True)) for row in inverse.tolist())

    def resolved(part: Coefficients) -> Coefficients:
        terms = [({s: c for s, c in part.items() if s not in new}, 1.0)]
        return _sum(*terms, *((outcome[c], part.get(symbol, 0.0)) for c, symbol in enumerate(new)))

    stages = tuple(Stage(s.offset, tuple(resolved(a) for a in s.arguments)) for s in tableau.stages)
    for number, stage in enumerate(stages):
        later = [s for a in stage.arguments for s in a if s[0] == "k" and s[1] > number]
        if later:
            raise ValueError(f"rules must be diagonally implicit; stage {number} needs the later rate {later[0][1]}")
    return Tableau(stages, outcome)


def combine(part: Mapping[Symbol, float], values: Mapping[Symbol, Array]) -> Array | float:
    """The form's value; 0.0 if it is empty.  Symbols without a value count as 0."""
    total: Array | float = 0.0
    for symbol, coefficient in part.items():
        if symbol in values:
            total = total + coefficient * values[symbol]
    return total


def self_weights(stage: Stage, number: int) -> tuple[float, ...]:
    """The weight of a stage's own rate in each of its arguments: all 0 for an explicit stage."""
    return tuple(argument.get(("k", number, 0), 0.0) for argument in stage.arguments)
