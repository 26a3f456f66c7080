"""1,000 free bodies, symplectic Euler: dsim, a minimal NumPy loop over arrays, and MuJoCo.

    python tests/benchmarks/bodies.py [bodies ...]

Ratios are dsim / other, in interleaved rounds, after the results have been found equal.
"""

from __future__ import annotations

import sys
from typing import Any

import measure  # first: it sets threads and paths
import numpy as np
from free_bodies import ours, problem

BAR = 1.15  # dsim / minimal loop


def minimal(given: dict[str, Any]) -> measure.Run:
    """The same by hand: arrays over bodies, no parameters, no derivatives, every state kept as dsim keeps it."""
    h, I = given["h"], given["moments"].T

    def run() -> Any:
        x, q = given["q"][:, :3].copy(), given["q"][:, 3:].T.copy()
        v, w = given["v"][:, :3].copy(), given["v"][:, 3:].T.copy()
        states = np.empty((given["steps"] + 1, 13 * len(x)))
        for n in range(given["steps"]):
            L = I * w
            w = w + h / I * np.stack([L[1] * w[2] - L[2] * w[1], L[2] * w[0] - L[0] * w[2], L[0] * w[1] - L[1] * w[0]])
            x = x + h * v
            angle = np.sqrt((w * w).sum(axis=0))
            c, s = np.cos(0.5 * h * angle), np.sin(0.5 * h * angle) / angle
            (a, b, d, e), (i, j, k) = q, s * w
            q = np.stack([a * c - b * i - d * j - e * k, a * i + b * c + d * k - e * j, a * j - b * k + d * c + e * i,
                          a * k + b * j - d * i + e * c])  # fmt: skip
            q = q / np.sqrt((q * q).sum(axis=0))
            row = states[n + 1]
            row[: 7 * len(x)].reshape(-1, 7)[:, :3], row[: 7 * len(x)].reshape(-1, 7)[:, 3:] = x, q.T
            row[7 * len(x) :].reshape(-1, 6)[:, :3], row[7 * len(x) :].reshape(-1, 6)[:, 3:] = v, w.T
        return np.concatenate([x, q.T], axis=1), np.concatenate([v, w.T], axis=1)

    return run


def main(sizes: list[int]) -> None:
    print(measure.versions())
    for bodies in sizes:
        given = problem(bodies)
        mine = ours(given)
        for name, other, bar in (("minimal loop", minimal(given), BAR), ("mujoco", _mujoco(given), None)):
            if other is None:
                continue
            different = measure.difference(mine(), other())
            assert different < 1e-10, f"{name}: results differ by {different:.1e}"
            print(measure.row(f"{bodies} bodies / {name}", measure.compare(mine, other), bar), flush=True)


def _mujoco(given: dict[str, Any]) -> measure.Run | None:
    from importlib.util import find_spec

    if find_spec("mujoco") is None:
        print("mujoco skipped: not installed")
        return None
    from mujoco_bodies import make

    run: measure.Run = make(given)
    return run


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [1000])
