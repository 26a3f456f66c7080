"""Explicit cloth, 200 symplectic Euler steps, against its peers:  python tests/benchmarks/explicit.py [n ...]

Every peer is held to 1e-10 before it is timed.  Ratios are dsim / peer, in interleaved rounds; compile time apart.
"""

from __future__ import annotations

import sys
from typing import Any

import measure  # first: it sets threads and paths
import problem as problems
from measure import Run

KINDS = ("forward", "forward + gradient")
BARS = {  # of the ratio: (forward, forward + gradient); Warp and the fused kernel are reported beside them
    ("jax_cloth", 32): (0.65, 0.65), ("jax_cloth", 64): (0.65, 0.65), ("jax_cloth", 128): (0.8, 0.75),
    ("taichi_cloth", 32): (0.45, 0.4), ("taichi_cloth", 64): (0.45, 0.4),
    ("warp_cloth", 32): (1.8, 1.5), ("warp_cloth", 64): (1.8, 1.5),
}  # fmt: skip


def ours(problem: dict[str, Any]) -> tuple[Run, Run, Run]:
    """(forward, forward + gradient, the way back alone) of dsim."""
    from dsim import adjoint, simulate
    from dsim.steppers import SymplecticEuler

    system, y0 = problems.dsim_system(problem), problems.dsim_state(problem)
    h, steps, load = problem["h"], problem["steps"], problem["weights"].ravel()

    def forward() -> Any:
        return simulate(SymplecticEuler(), system, y0, h, steps).last.reshape(2, -1, 3)

    def gradient(run: Any = None) -> Any:
        run = simulate(SymplecticEuler(), system, y0, h, steps, keep="steps") if run is None else run
        found = adjoint(run, load)
        return found["springs.stiffness"], found.y0[system.n :].reshape(-1, 3)

    kept = simulate(SymplecticEuler(), system, y0, h, steps, keep="steps")
    return forward, gradient, lambda: gradient(kept)


def main(sizes: list[int]) -> None:
    print(measure.versions())
    print("dsim / peer: median [quartiles], control, milliseconds a run")
    for n in sizes:
        problem = problems.cloth(n)
        *mine, back = ours(problem)
        for name in ("jax_cloth", "taichi_cloth", "taichi_fused", "warp_cloth"):
            theirs = measure.peer(name, problem)
            for kind, a, b in zip(range(2), mine, theirs or (), strict=bool(theirs)):
                compiled = measure.seconds(b)
                different = measure.difference(a(), b())
                assert different < 1e-10, f"{name}, {KINDS[kind]}: results differ by {different:.1e}"
                bar = BARS.get((name, n), (None, None))[kind]
                line = measure.row(f"n={n:3d} {name} {KINDS[kind]}", measure.compare(a, b), bar)
                print(f"{line}, first call {compiled:.1f} s", flush=True)
        print(measure.row(f"n={n:3d} adjoint / forward", measure.compare(back, mine[0]), 1.1), flush=True)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [32, 64, 128])
