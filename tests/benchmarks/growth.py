"""How time and memory grow with unknowns and with steps: log-log slopes.  python tests/benchmarks/growth.py

Explicit forward runs and gradients, implicit steps; memory is NumPy's peak as tracemalloc sees it.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import measure  # first: it sets threads and paths
import numpy as np
import problem as problems


def peak(f: Callable[[], Any]) -> float:
    """Bytes allocated at the highest point."""
    tracemalloc.start()
    f()
    _, highest = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return float(highest)


def slope(x: list[float], y: list[float]) -> float:
    """The exponent of a power law through the points."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def runs(kind: str, n: int, steps: int) -> tuple[int, Callable[[], Any]]:
    """(unknowns, one run)."""
    from dsim import adjoint, simulate
    from dsim.steppers import BackwardEuler, SymplecticEuler

    problem = problems.implicit_cloth(n, steps) if kind == "implicit" else problems.cloth(n, steps)
    system, y0, h = problems.dsim_system(problem), problems.dsim_state(problem), problem["h"]
    if kind == "implicit":
        return system.n, lambda: simulate(BackwardEuler(), system, y0, h, steps).last
    if kind == "explicit":
        return system.n, lambda: simulate(SymplecticEuler(), system, y0, h, steps).last
    load = problem["weights"].ravel()
    return system.n, lambda: adjoint(simulate(SymplecticEuler(), system, y0, h, steps, keep="steps"), load)


def main() -> None:
    print(f"{'':22s} {'varied':10s} {'from':>8s} {'to':>8s} {'time ~':>8s} {'memory ~':>9s}")
    plans = {"explicit": ((16, 32, 64, 128), 50), "gradient": ((16, 32, 64, 128), 50), "implicit": ((16, 32, 64), 4)}
    for kind, (sizes, steps) in plans.items():
        cases = {
            "unknowns": [(n, steps) for n in sizes],
            "steps": [(sizes[1], steps * factor) for factor in (1, 2, 4, 8)],
        }
        for varied, pairs in cases.items():
            amounts, times, memory = [], [], []
            for n, count in pairs:
                unknowns, f = runs(kind, n, count)
                f()
                amounts.append(float(unknowns if varied == "unknowns" else count))
                times.append(min(measure.seconds(f) for _ in range(5)))
                memory.append(peak(f))
            print(
                f"{kind:22s} {varied:10s} {amounts[0]:8.0f} {amounts[-1]:8.0f} "
                f"{slope(amounts, times):8.2f} {slope(amounts, memory):9.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
