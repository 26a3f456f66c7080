"""Free bodies for comparisons: the problem, and dsim's run of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def problem(bodies: int, steps: int = 50, h: float = 0.01, seed: int = 0) -> dict[str, Any]:
    """Bodies of three different moments at random attitudes, with random velocities and spins."""
    rng = np.random.default_rng(seed)
    q = np.concatenate([rng.normal(size=(bodies, 3)), rng.normal(size=(bodies, 4))], axis=1)
    q[:, 3:] /= np.linalg.norm(q[:, 3:], axis=1, keepdims=True)
    moments = rng.uniform([0.8, 1.2, 1.6], [1.0, 1.5, 1.9], (bodies, 3))
    return {"mass": rng.uniform(0.5, 2.0, bodies), "moments": moments, "q": q, "v": rng.normal(size=(bodies, 6)),
            "h": h, "steps": steps}  # fmt: skip


def ours(given: dict[str, Any]) -> Callable[[], Any]:
    """dsim's run."""
    from dsim import simulate
    from dsim.rigid import RigidBodies
    from dsim.steppers import SymplecticEuler

    system = RigidBodies(given["mass"], np.stack([np.diag(row) for row in given["moments"]]))
    y0, stepper = np.concatenate([given["q"].ravel(), given["v"].ravel()]), SymplecticEuler()

    def run() -> Any:
        last = simulate(stepper, system, y0, given["h"], given["steps"]).last
        return last[: system.width].reshape(-1, 7), last[system.width :].reshape(-1, 6)

    return run
