"""dsim against every peer that is installed:  python tests/benchmarks/equality.py [n ...]

One row a comparison, with the largest relative difference; the exit code is 1 if one is above round-off.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import explicit  # first: it sets threads and paths
import numpy as np
import problem as problems

TOLERANCE = 1e-10  # implicit runs reach it too: the last Newton correction is 1e-10, the error after it smaller

EXPLICIT = {"jax_cloth": "jax", "taichi_cloth": "taichi", "warp_cloth": "warp"}  # peer: the package it needs
IMPLICIT = {"jax_implicit": "jax", "cholmod_cloth": "cvxopt"}


def implicit(problem: dict[str, Any]) -> Any:
    """The last (q, v) of dsim's backward Euler."""
    from dsim import simulate
    from dsim.steppers import BackwardEuler

    system, y0 = problems.dsim_system(problem), problems.dsim_state(problem)
    return simulate(BackwardEuler(), system, y0, problem["h"], problem["steps"]).y[-1].reshape(2, -1, 3)


def difference(mine: Any, theirs: Any) -> float:
    """Largest relative difference, NaN if anything is."""
    return float(np.max([explicit.agree([a], [b]) for a, b in zip(mine, theirs, strict=True)]))


def compare(n: int, peers: dict[str, str], problem: dict[str, Any], mine: dict[str, Any]) -> bool:
    """Print the rows of these peers; mine: name of a result -> dsim's.  True if all of them agree."""
    passed = True
    for peer, package in peers.items():
        if find_spec(package) is None:
            print(f"n={n:3d} {peer:14s} skipped: not installed ({package})", flush=True)
            continue
        made = importlib.import_module(peer).make(problem)
        functions: tuple[Callable[..., Any], ...] = made if isinstance(made, tuple) else (made,)
        for (name, expected), function in zip(mine.items(), functions, strict=True):
            found = difference(expected, function(problem["stiffness"], problem["v0"]))
            equal = found <= TOLERANCE
            passed &= equal
            print(f"n={n:3d} {peer:14s} {name:8s} {found:.1e} {'' if equal else 'DIFFERS'}".rstrip(), flush=True)
    return passed


def main(sizes: list[int]) -> int:
    passed = True
    for n in sizes:
        problem = problems.cloth(n)
        forward, gradient = explicit.ours(problem)
        passed &= compare(n, EXPLICIT, problem, {"forward": forward(), "gradient": gradient()})
        problem = problems.implicit_cloth(n)
        passed &= compare(n, IMPLICIT, problem, {"forward": implicit(problem)})
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main([int(word) for word in sys.argv[1:]] or [8, 16]))
