"""Explicit cloth against JAX, interleaved:  python tests/benchmarks/explicit.py [n ...]

One core by affinity, one BLAS thread, float64, warm; compile time apart.  Every round runs dsim, the peer, the peer
and dsim again (ABBA), with dsim against itself as the control; ratios are taken within a round, and their median
and quartiles are printed.
"""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.update({name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")})
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent / "peers")]

import numpy as np  # noqa: E402
import problem as problems  # noqa: E402


def ours(problem: dict[str, Any]) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """(forward, forward + gradient) of dsim."""
    from dsim import adjoint, simulate
    from dsim.steppers import SymplecticEuler

    system, y0 = problems.dsim_system(problem), problems.dsim_state(problem)
    load = np.zeros((problem["steps"] + 1, system.size))
    load[-1] = problem["weights"].ravel()

    def forward() -> Any:
        y = simulate(SymplecticEuler(), system, y0, problem["h"], problem["steps"]).y[-1]
        return y.reshape(2, -1, 3)

    def gradient() -> Any:
        run = simulate(SymplecticEuler(), system, y0, problem["h"], problem["steps"], keep="steps")
        found = adjoint(run, load)
        return found["springs.stiffness"], found.y0[system.n :].reshape(-1, 3)

    return forward, gradient


def jax_peer(problem: dict[str, Any]) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """(forward, gradient) of JAX, waiting for the result."""
    import jax
    import jax_cloth

    forward, gradient = jax_cloth.make(problem)
    arguments = (problem["stiffness"], problem["v0"])
    return (lambda: jax.block_until_ready(forward(*arguments)), lambda: jax.block_until_ready(gradient(*arguments)))


def seconds(f: Callable[[], Any]) -> float:
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def compare(a: Callable[[], Any], b: Callable[[], Any], rounds: int = 9) -> dict[str, Any]:
    """Paired ratios a/b of ABBA rounds, and a/a as the control."""
    gc.disable()
    pairs, control, times = [], [], []
    for _ in range(rounds):
        first, second, third, last = seconds(a), seconds(b), seconds(b), seconds(a)
        pairs.append((first + last) / (second + third))
        control.append(first / last)
        times.append(min(first, last))
    gc.enable()
    return {
        "ratio": np.percentile(pairs, [25, 50, 75]),
        "control": np.percentile(control, [25, 50, 75]),
        "a": min(times),
    }


def agree(mine: Any, theirs: Any) -> float:
    """Largest relative difference; the timing means nothing if it is not round-off."""
    return max(float(np.abs(a - np.asarray(b)).max() / np.abs(a).max()) for a, b in zip(mine, theirs, strict=True))


def main(sizes: list[int]) -> None:
    import jax
    import scipy

    print(f"numpy {np.__version__}, scipy {scipy.__version__}, jax {jax.__version__}; dsim / JAX, median [quartiles]")
    for n in sizes:
        problem = problems.cloth(n)
        mine, theirs = ours(problem), jax_peer(problem)
        for name, a, b in zip(("forward", "forward + gradient"), mine, theirs, strict=True):
            compiled = seconds(b)
            difference = agree(a(), b())
            assert difference < 1e-10, f"{name}: the simulators differ by {difference:.1e}"
            found = compare(a, b)
            low, middle, high = found["ratio"]
            noise = "{:.2f} [{:.2f}, {:.2f}]".format(*found["control"][[1, 0, 2]])
            micro = 1e6 * found["a"] / problem["steps"]
            print(
                f"n={n:4d} {name:19s} {middle:.2f} [{low:.2f}, {high:.2f}]  A/A {noise}  "
                f"{micro:.0f} us a step, compile {compiled:.1f} s, difference {difference:.0e}",
                flush=True,
            )


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [32, 64, 128])
