"""dsim against every peer that is installed:  python tests/benchmarks/equality.py [n ...]

One row a comparison, with the largest relative difference; the exit code is 1 if one is above round-off.
"""

from __future__ import annotations

import sys
from typing import Any

import explicit
import measure  # sets threads and paths
import problem as problems

TOLERANCE = 1e-10  # implicit runs reach it too: the last Newton correction is 1e-10, the error after it smaller

EXPLICIT = ("jax_cloth", "taichi_cloth", "taichi_fused", "warp_cloth")
IMPLICIT = ("jax_implicit", "cholmod_cloth")


def implicit(problem: dict[str, Any]) -> Any:
    """The last (q, v) of dsim's backward Euler."""
    from dsim import simulate
    from dsim.steppers import BackwardEuler

    system, y0 = problems.dsim_system(problem), problems.dsim_state(problem)
    return simulate(BackwardEuler(), system, y0, problem["h"], problem["steps"]).last.reshape(2, -1, 3)


def compare(peers: tuple[str, ...], problem: dict[str, Any], mine: dict[str, Any]) -> bool:
    """Print the rows of these peers; mine: name of a result -> dsim's.  True if all of them agree."""
    passed = True
    for name in peers:
        runs = measure.peer(name, problem)
        for (kind, expected), run in zip(mine.items(), runs or (), strict=bool(runs)):
            found = measure.difference(expected, run())
            equal = found <= TOLERANCE
            passed &= equal
            verdict = "" if equal else "DIFFERS"
            print(f"n={problem['n']:3d} {name:14s} {kind:8s} {found:.1e} {verdict}".rstrip(), flush=True)
    return passed


def main(sizes: list[int]) -> int:
    passed = True
    for n in sizes:
        problem = problems.cloth(n)
        forward, gradient, _ = explicit.ours(problem)
        passed &= compare(EXPLICIT, problem, {"forward": forward(), "gradient": gradient()})
        problem = problems.implicit_cloth(n)
        passed &= compare(IMPLICIT, problem, {"forward": implicit(problem)})
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main([int(word) for word in sys.argv[1:]] or [8, 16]))
