"""From a fresh process to the first gradient, n = 16:  python tests/benchmarks/startup.py [rounds]

Interpreter start, imports and compilation included; JAX without a compilation cache.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import measure  # first: it sets threads and paths

HERE = Path(__file__).parent
OURS = "import explicit, problem; explicit.ours(problem.cloth(16))[1]()"
JAX = "import measure, problem; measure.peer('jax_cloth', problem.cloth(16))[1]()"


def fresh(program: str) -> None:
    subprocess.run([sys.executable, "-c", program], check=True, cwd=HERE)


def main(rounds: int) -> None:
    print(measure.versions())
    found = measure.compare(lambda: fresh(OURS), lambda: fresh(JAX), rounds)
    print(measure.row("first gradient, n=16, dsim / JAX", found, 1 / 8))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
