"""The pay-back table: what each effect costs, and what it changes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.simulation import record
from dsim.solve.newton import Status
from dsim.system import System


@dataclass(frozen=True)
class PayBack:
    """One effect left out: seconds with it over seconds without, and how far the positions then go astray."""

    effect: str
    cost: float  # median paired ratio of run times, with / without
    change: float  # largest change of a position in the run, relative to the largest displacement; inf: it fails
    forces: int  # force evaluations with it, less those without


def pay_back(scene: Any, rounds: int = 5) -> tuple[PayBack, ...]:
    """Every effect of a scene in turn.  Times are paired within a round, with and without in alternating order."""
    if not isinstance(scene.system, System):
        raise ValueError(f"scene must be a system of masses with effects; {scene.name} is a flow")
    whole = _run(scene, scene.system)
    moved = max(float(np.abs(whole.q - whole.q[0]).max()), 1e-300)
    rows = []
    for effect in scene.system.effects:
        without = scene.system.without(effect.name)
        run = _run(scene, without)
        failed = run.status is not Status.CONVERGED
        change = np.inf if failed else float(np.abs(run.q - whole.q).max()) / moved
        ratios = [_ratio(scene, without, swap=number % 2 == 1) for number in range(rounds)]
        rows.append(PayBack(effect.name, float(np.median(ratios)), change, whole.counters.forces - run.counters.forces))
    return tuple(rows)


def _run(scene: Any, system: System) -> Any:
    return record(scene.stepper, system, scene.y0, scene.h, scene.steps)


def _ratio(scene: Any, without: System, swap: bool) -> float:
    seconds = []
    for system in (without, scene.system) if swap else (scene.system, without):
        start = time.perf_counter()
        _run(scene, system)
        seconds.append(time.perf_counter() - start)
    return seconds[1] / seconds[0] if swap else seconds[0] / seconds[1]
