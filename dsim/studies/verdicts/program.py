"""First verdict: is it the derivative of the program?

Every block of x is moved along a few directions - single entries, the largest ones among them, random sums that look
at all entries together, and one of the faint entries alone - and `check_gradient` judges the slopes.  A block found
wrong is judged again after fewer steps: the first step after which the gradient is wrong is where the bug acts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.studies.gradient_check import GradientReport, Verdict, check_gradient
from dsim.studies.verdicts.simulator import Simulator

SINGLE, SUMS = 3, 2  # directions looked at in a block: single entries, and random sums of all
FAINT = 1e-3  # entries below this share of the largest are summed alone too: beside it a wrong one does not show
SCAN = 32  # so many steps are tried one by one


@dataclass(frozen=True, eq=False)
class BlockVerdict:
    """What was found for one block; first_bad_step counts from 1, None where the gradient is right."""

    block: str
    verdict: Verdict
    digits: float
    given: float
    numerical: float
    where: str  # the entry or direction that decided
    first_bad_step: int | None = None


@dataclass(frozen=True, eq=False)
class ProgramVerdict:
    """right: every block is smooth and agrees.  Else the worst word found: wrong, jump, kink or noise."""

    blocks: tuple[BlockVerdict, ...]
    evaluations: int

    @property
    def verdict(self) -> str:
        words = {block.verdict for block in self.blocks}
        return next((word for word in ("wrong", "jump", "kink", "noise") if word in words), "right")

    @property
    def digits(self) -> float:
        """Of the worst block."""
        return min(block.digits for block in self.blocks)

    @property
    def wrong(self) -> tuple[BlockVerdict, ...]:
        """The blocks found wrong, those that go wrong first in front."""
        found = [block for block in self.blocks if block.verdict == "wrong"]
        return tuple(sorted(found, key=lambda block: block.first_bad_step or 0))

    def __str__(self) -> str:
        if self.verdict == "right":
            return f"right, {self.digits:.1f} digits in the worst of {len(self.blocks)} blocks"
        if self.verdict != "wrong":
            names = ", ".join(block.block for block in self.blocks if block.verdict == self.verdict)
            return f"{self.verdict} in {names}"
        places = [f"{block.block} from step {block.first_bad_step}" for block in self.wrong]
        return "wrong: " + ", ".join(places)


def judge_program(simulator: Simulator, w: Array | None = None, seed: int = 0) -> ProgramVerdict:
    """Verdict 1 on the gradient of w . y (random w by default), block by block."""
    w = simulator.weights(seed) if w is None else w
    gradient = simulator.pulled(w)
    found, evaluations = [], 0
    for block, places in simulator.blocks.items():
        rng = np.random.default_rng(seed)
        directions, labels = _directions(simulator, places, gradient, rng)
        report = _checked(simulator, w, directions, simulator.steps)
        evaluations += report.evaluations
        if report.ok and (alone := _faint(simulator, places, gradient, rng)) is not None:
            closer = _checked(simulator, w, alone, simulator.steps)
            evaluations += closer.evaluations
            if closer.verdict == "wrong":  # no other verdict counts: they are small enough for round-off to hide them
                report, directions, labels = closer, alone, ["random sum of faint entries"]
        verdict = report.verdict
        first = None
        if verdict == "wrong":  # a random sum of all directions sees what any of them sees
            first = _first_bad_step(simulator, w, directions @ rng.normal(size=(len(labels), 1)))
        i = report.worst_index
        given = np.nan if report.given is None else float(report.given[i])
        numerical = float(report.numerical[i])
        found.append(BlockVerdict(block, verdict, report.digits, given, numerical, labels[i], first))
    return ProgramVerdict(tuple(found), evaluations)


def _directions(simulator: Simulator, places: Any, gradient: Array, rng: Any) -> tuple[Array, list[str]]:
    """(k,D) and a label each, lengths of the size of x."""
    size, count = simulator.scale[places[0]], len(places)
    chosen = np.arange(count)
    if count > SINGLE + SUMS:
        largest = np.argsort(-np.abs(np.nan_to_num(gradient[places], nan=np.inf)), kind="stable")[: SINGLE - 1]
        others = rng.permutation(np.setdiff1d(np.arange(count), largest))[: SINGLE - len(largest)]
        chosen = np.concatenate([largest, others])
    sums = SUMS if count > len(chosen) else 0
    directions = np.zeros((len(simulator.x), len(chosen) + sums))
    directions[places[chosen], np.arange(len(chosen))] = size
    directions[places, len(chosen) :] = size * rng.normal(size=(count, sums))  # signs alone can cancel
    labels = [f"entry {i}" for i in chosen] + [f"random sum {i}" for i in range(sums)]
    return directions, labels


def _faint(simulator: Simulator, places: Any, gradient: Array, rng: Any) -> Array | None:
    """A random sum of the entries whose part of the gradient is small (k,1), or None."""
    size = np.abs(gradient[places])
    faint = places[(0 < size) & (size < FAINT * size.max())]
    if len(places) <= SINGLE + SUMS or not len(faint):
        return None
    direction = np.zeros((len(simulator.x), 1))
    direction[faint, 0] = simulator.scale[places[0]] * rng.normal(size=len(faint))
    return direction


def _checked(simulator: Simulator, w: Array, directions: Array, steps: int) -> GradientReport:
    """w . y after so many steps, as a function of the lengths along the directions."""
    given = _product(simulator.pulled(w, steps=steps), directions)

    def value(lengths: Array) -> Any:
        y = simulator.state(simulator.x + directions @ lengths, steps)
        return (y @ w.astype(y.dtype)).astype(y.dtype)

    return check_gradient(value, np.zeros(directions.shape[1]), given)


def _product(gradient: Array, directions: Array) -> Array:
    """directions^T gradient, in which an entry that is not finite spoils only the directions that move it."""
    moved = np.where(directions != 0, directions * gradient[:, None], 0.0)
    return moved.sum(axis=0)


def _first_bad_step(simulator: Simulator, w: Array, directions: Array) -> int:
    """The least number of steps after which the gradient is wrong.

    All numbers up to SCAN are tried; beyond, they double, and the last gap is halved: a gradient that is wrong in
    between and right again would be missed.
    """

    def wrong(steps: int) -> bool:
        return _checked(simulator, w, directions, steps).verdict == "wrong"

    good, total = 0, simulator.steps
    while good < total:
        tried = min(total, good + 1 if good < SCAN else 2 * good)
        if wrong(tried):
            break
        good = tried
    bad = min(total, good + 1 if good < SCAN else 2 * good)
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (good, middle) if wrong(middle) else (middle, bad)
    return bad
