"""Stiff cloth, backward Euler, k h^2 / m = 1e3, against its peers:  python tests/benchmarks/implicit.py [n ...]

JAX: Newton with conjugate gradients, as Jacobi-preconditioned CG to 1e-6 and in the quickest variant found (3 x 3
blocks, two digits); CHOLMOD: Newton with a sparse Cholesky factorization.  Ratios are dsim / peer.
"""

from __future__ import annotations

import sys
from typing import Any

import measure  # first: it sets threads and paths
import problem as problems

VARIANTS: list[tuple[str, str, dict[str, Any], dict[int, float]]] = [
    ("jax_implicit", "JAX, Jacobi-CG", {"blocks": False, "linear_tol": 1e-6}, {16: 0.25, 32: 0.1, 64: 0.1}),
    ("jax_implicit", "JAX, quickest", {}, {}),
    ("cholmod_cloth", "CHOLMOD", {}, {16: 1.2, 32: 1.2, 64: 1.2}),
]


def main(sizes: list[int]) -> None:
    from dsim import adjoint, simulate
    from dsim.steppers import BackwardEuler

    print(measure.versions())
    print("dsim / peer: median [quartiles], control, milliseconds a step")
    for n in sizes:
        problem = problems.implicit_cloth(n)
        system, y0, steps = problems.dsim_system(problem), problems.dsim_state(problem), problem["steps"]

        def run(keep: Any = "states") -> Any:
            return simulate(BackwardEuler(), system, y0, problem["h"], steps, keep=keep)  # noqa: B023

        counters = run().counters
        for name, label, options, bars in VARIANTS:
            theirs = measure.peer(name, problem, **options)
            if theirs is None:
                continue
            theirs[0]()
            different = measure.difference(run().last.reshape(2, -1, 3), theirs[0]())
            assert different < 1e-10, f"{label}: results differ by {different:.1e}"
            found = measure.compare(run, theirs[0], rounds=5)
            print(measure.row(f"n={n:3d} {label}", found, bars.get(n), steps), flush=True)
        load = problem["weights"].ravel()
        for keep, bar in (("steps", 0.5), ("factors", 0.25)):
            kept = run(keep)
            found = measure.compare(lambda kept=kept, load=load: adjoint(kept, load), run, rounds=5)
            print(measure.row(f"n={n:3d} adjoint / forward, keep={keep}", found, bar, steps), flush=True)
        a_step = f"{counters.newton_iterations / steps:.1f} iterations, {counters.factorizations / steps:.1f} factors"
        print(f"n={n:3d} Newton: {a_step} a step", flush=True)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [16, 32, 64])
