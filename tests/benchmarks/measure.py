"""How the benchmarks measure: one core by affinity, one BLAS thread, paired ratios with a control.

Import this first: it sets threads before anything reads them.
"""

from __future__ import annotations

import gc
import importlib
import os
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.update({name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")})
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent / "peers")]

import numpy as np  # noqa: E402

Run = Callable[[], Any]
PACKAGES = {  # peer: the package it needs
    "jax_cloth": "jax", "taichi_cloth": "taichi", "taichi_fused": "taichi", "warp_cloth": "warp",
    "jax_implicit": "jax", "cholmod_cloth": "cvxopt",
}  # fmt: skip


def peer(name: str, problem: dict[str, Any], **options: Any) -> tuple[Run, ...] | None:
    """The peer's runs, waiting for their results; None, and a line that says so, where its package is missing."""
    if find_spec(PACKAGES[name]) is None:
        print(f"{name:14s} skipped: not installed ({PACKAGES[name]})", flush=True)
        return None
    made = importlib.import_module(name).make(problem, **options)
    made = made if isinstance(made, tuple) else (made,)
    arguments = (problem["stiffness"], problem["v0"])
    return tuple(lambda f=f: tuple(np.asarray(part) for part in f(*arguments)) for f in made)


def versions() -> str:
    """The packages' versions that are installed."""
    from importlib.metadata import PackageNotFoundError, version

    found = []
    for name in ("numpy", "scipy", "jax", "taichi", "warp-lang", "cvxopt"):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} -")
    return ", ".join(found)


def seconds(f: Run) -> float:
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def compare(a: Run, b: Run, rounds: int = 9) -> dict[str, Any]:
    """Paired ratios a/b of ABBA rounds (quartiles), a/a as the control, the quickest of each."""
    gc.disable()
    pairs, control, ours, theirs = [], [], [], []
    for _ in range(rounds):
        first, second, third, last = seconds(a), seconds(b), seconds(b), seconds(a)
        pairs.append((first + last) / (second + third))
        control.append(first / last)
        ours.append(min(first, last))
        theirs.append(min(second, third))
    gc.enable()
    quartiles = (25, 50, 75)
    return {
        "ratio": np.percentile(pairs, quartiles), "control": np.percentile(control, quartiles),
        "a": min(ours), "b": min(theirs),
    }  # fmt: skip


def difference(mine: Any, theirs: Any) -> float:
    """Largest relative difference; NaN if anything is, so that no comparison with a bound passes."""
    pairs = zip(mine, theirs, strict=True)
    return float(np.max([np.abs(a - np.asarray(b)).max() / np.abs(a).max() for a, b in pairs]))


def row(label: str, found: dict[str, Any], bar: float | None, per: int = 1) -> str:
    """One line of a table: the ratio, its quartiles, the control, both times, the bar and whether it is met."""
    low, middle, high = found["ratio"]
    noise = found["control"]
    verdict = "" if bar is None else f" bar {bar:.2f} {'met' if middle <= bar else 'MISSED'}"
    times = f"{1e3 * found['a'] / per:8.3f} / {1e3 * found['b'] / per:8.3f} ms"
    return f"{label:34s} {middle:5.2f} [{low:.2f}, {high:.2f}] A/A [{noise[0]:.2f}, {noise[2]:.2f}] {times}{verdict}"
