"""How time and memory grow with the unknowns and with the steps: measured on a cloth, fitted by power laws."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from dsim import scenes
from dsim.gradients.adjoint import adjoint
from dsim.planning import highest_frequency
from dsim.simulation import simulate
from dsim.steppers import BackwardEuler, SymplecticEuler
from dsim.studies.stopwatch import one_thread, without_collector

KINDS = ("explicit run", "explicit run and gradient", "implicit run")


@dataclass(frozen=True)
class Growth:
    """One kind of run along one amount: seconds (least of the repeats) and peak bytes, and their exponents."""

    kind: str
    varied: str  # "unknowns" or "steps"
    amounts: tuple[float, ...]
    seconds: tuple[float, ...]
    bytes: tuple[float, ...]

    @property
    def time_exponent(self) -> float:
        return exponent(self.amounts, self.seconds)

    @property
    def memory_exponent(self) -> float:
        return exponent(self.amounts, self.bytes)


def exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """The slope of log y over log x.

    >>> round(exponent([1.0, 2.0, 4.0], [3.0, 12.0, 48.0]), 6)
    2.0
    """
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def runner(kind: str, n: int, steps: int) -> tuple[int, Callable[[], Any]]:
    """(unknowns, a run) of an n x n cloth.  kind: one of KINDS."""
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}; got {kind!r}")
    scene = scenes.cloth(n=n)
    system: Any = scene.system
    if kind == "implicit run":
        return system.n, partial(simulate, BackwardEuler(), system, scene.y0, scene.h, steps)
    h = 1.0 / highest_frequency(system, scene.y0)
    if kind == "explicit run":
        return system.n, partial(simulate, SymplecticEuler(), system, scene.y0, h, steps)

    def gradient() -> Any:
        run = simulate(SymplecticEuler(), system, scene.y0, h, steps, keep="steps")
        return adjoint(run, np.ones(system.size))

    return system.n, gradient


def measure(kind: str, varied: str, cases: Iterable[tuple[int, int]], repeats: int = 3) -> Growth:
    """Time and memory of the (n, steps) cases, which differ in n (varied "unknowns") or in steps."""
    if varied not in ("unknowns", "steps"):
        raise ValueError(f'varied must be "unknowns" or "steps"; got {varied!r}')
    amounts, seconds, sizes = [], [], []
    for n, steps in cases:
        unknowns, run = runner(kind, n, steps)
        run()
        amounts.append(float(unknowns if varied == "unknowns" else steps))
        with one_thread(), without_collector():
            seconds.append(min(_seconds(run) for _ in range(repeats)))
        sizes.append(_peak(run))
    return Growth(kind, varied, tuple(amounts), tuple(seconds), tuple(sizes))


def _seconds(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _peak(run: Callable[[], Any]) -> float:
    """Bytes at the highest point, as NumPy reports them to tracemalloc."""
    tracemalloc.start()
    try:
        run()
        return float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
