"""Seconds that mean something on a noisy machine: chunks, interleaving, medians of paired ratios, an A/A control."""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

CHUNK = 5e-3  # s; shorter runs are repeated within one reading of the clock
SLOW = 0.1  # s; a run this long is timed in one ABBA round only
LONG = 1.0  # s; a run this long is timed once: what disturbs it averages out within
CONTROL, TWIN = "control A", "control A'"


@dataclass(frozen=True)
class Timing:
    """Seconds of one run: the least, the median and the quartiles; median ratio to the control, chunk by chunk, and
    the control's least seconds."""

    least: float
    median: float
    low: float
    high: float
    ratio: float
    control: float
    repeats: int


def time_interleaved(
    runs: Mapping[str, Callable[[], Any]], control: Callable[[], Any], rounds: int = 3
) -> tuple[dict[str, Timing], tuple[float, float]]:
    """Time every run, in the order A B C ... C B A, and the control twice: (timings, the A/A ratio's range).

    A machine that slows down in between slows neighbours alike; what the ratio of two equal runs still shows is noise.
    """
    chosen = {CONTROL: control, **runs, TWIN: control}
    counts, turns = {}, {}
    for name, run in chosen.items():
        start = time.perf_counter()
        run()
        once = time.perf_counter() - start
        counts[name], turns[name] = max(1, int(np.ceil(CHUNK / max(once, 1e-7)))), 2 * max(1, rounds)
        if once > SLOW and name not in (CONTROL, TWIN):
            turns[name] = 1 if once > LONG else 2
    readings: dict[str, list[float]] = {name: [] for name in chosen}
    with one_thread(), without_collector():
        for turn in range(2 * max(1, rounds)):
            order = list(chosen) if turn % 2 == 0 else list(chosen)[::-1]
            for name in order:
                if turn < turns[name]:
                    readings[name].append(_read(chosen[name], counts[name]))
    base, twin = np.array(readings[CONTROL]), np.array(readings[TWIN])
    ratios = twin / base
    band = (float(min(ratios.min(), 1 / ratios.max())), float(max(ratios.max(), 1 / ratios.min())))
    return {name: _summary(np.array(readings[name]), base) for name in runs}, band


def _read(run: Callable[[], Any], count: int) -> float:
    start = time.perf_counter()
    for _ in range(count):
        run()
    return (time.perf_counter() - start) / count


def _summary(seconds: Any, base: Any) -> Timing:
    low, median, high = (float(x) for x in np.percentile(seconds, [25, 50, 75]))
    ratio = float(np.median(seconds / base[: len(seconds)]))
    return Timing(float(seconds.min()), median, low, high, ratio, float(base.min()), len(seconds))


@contextmanager
def without_collector() -> Iterator[None]:
    """The garbage collector off, and as it was afterwards."""
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


@contextmanager
def one_thread() -> Iterator[bool]:
    """One BLAS thread, where NumPy and SciPy bring OpenBLAS along; yields whether it could be set."""
    libraries = _openblas()
    before = [get() for get, _ in libraries]
    for _, put in libraries:
        put(1)
    try:
        yield bool(libraries)
    finally:
        for (_, put), count in zip(libraries, before, strict=True):
            put(count)


def _openblas() -> list[tuple[Any, Any]]:
    import scipy

    found = []
    for package in (np, scipy):
        folder = Path(str(package.__file__)).parent
        for path in (*folder.parent.glob(f"{folder.name}.libs/*openblas*"), *folder.glob(".dylibs/*openblas*")):
            with suppress(OSError):
                library = ctypes.CDLL(str(path))
                for prefix, suffix in (("scipy_", "64_"), ("scipy_", ""), ("", "64_"), ("", "")):
                    names = [f"{prefix}openblas_{verb}_num_threads{suffix}" for verb in ("get", "set")]
                    if all(hasattr(library, name) for name in names):
                        found.append((getattr(library, names[0]), getattr(library, names[1])))
                        break
    return found
