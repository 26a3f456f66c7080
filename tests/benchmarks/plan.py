"""What the library costs over a hand-written loop: free particles under gravity and drag, symplectic Euler.

    python tests/benchmarks/plan.py [particles ...]

The loop is the one a NumPy user writes for exactly this scene, in place, keeping every state.
"""

from __future__ import annotations

import sys
from typing import Any

import measure  # first: it sets threads and paths
import numpy as np

STEPS, H, MASS, DRAG = 300, 1e-3, 0.1, 0.02
GRAVITY = np.array([0.0, 0.0, -9.81])
BARS = {100: 1.5, 1000: 1.1, 10000: 1.1}


def by_hand(q: Any, v: Any) -> Any:
    """q, v (N,3) -> states (steps + 1, 2, N, 3)."""
    states = np.empty((STEPS + 1, 2, *q.shape))
    states[0] = q, v
    weight, force = MASS * GRAVITY, np.empty_like(q)
    for n in range(STEPS):
        (q, v), (q1, v1) = states[n], states[n + 1]
        np.multiply(v, -DRAG, out=force)
        force += weight
        force *= H / MASS
        np.add(v, force, out=v1)
        np.multiply(v1, H, out=q1)
        q1 += q
    return states


def main(sizes: list[int]) -> None:
    from dsim import System, simulate
    from dsim.effects import Drag, Gravity
    from dsim.steppers import SymplecticEuler

    print(measure.versions())
    print("dsim / hand-written loop: median [quartiles], control, milliseconds a run")
    for count in sizes:
        q, v = np.random.default_rng(0).normal(size=(2, count, 3))
        system = System(np.full(count, MASS), (Gravity(GRAVITY), Drag(DRAG)))
        y0 = np.concatenate([q.ravel(), v.ravel()])

        def ours(system: Any = system, y0: Any = y0) -> Any:
            return simulate(SymplecticEuler(), system, y0, H, STEPS)

        different = measure.difference([ours().last], [by_hand(q, v)[-1].ravel()])
        assert different < 1e-12, f"results differ by {different:.1e}"
        found = measure.compare(ours, lambda q=q, v=v: by_hand(q, v), rounds=15)
        print(measure.row(f"{count} particles", found, BARS.get(count)), flush=True)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [100, 1000, 10000])
