"""The benchmark's cloth: n x n points, structural and shear springs as a plain edge list, one pinned edge."""

from __future__ import annotations

from typing import Any

import numpy as np


def cloth(n: int, steps: int = 200, stiffness: float = 500.0, h: float = 1e-3) -> dict[str, Any]:
    """Arrays alone, so that every simulator can take them.  Mass 0.01 kg a point, gravity, drag."""
    rng = np.random.default_rng(n)
    index = np.arange(n * n).reshape(n, n)
    lines = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:])]
    lines.append((index[1:, :-1], index[:-1, 1:]))
    pairs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in lines])
    grid = np.stack(np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij"), axis=-1)
    q0 = np.concatenate([grid.reshape(-1, 2), np.zeros((n * n, 1))], axis=1)
    rest = np.linalg.norm(q0[pairs[:, 1]] - q0[pairs[:, 0]], axis=1)
    q0 = q0 + 1e-3 * rng.normal(size=q0.shape) / n
    free = np.ones(n * n)
    free[index[0]] = 0.0
    return {
        "n": n,
        "pairs": pairs,
        "rest": rest,
        "stiffness": stiffness * rng.uniform(0.8, 1.2, len(pairs)),
        "mass": 0.01,
        "gravity": np.array([0.0, 0.0, -9.81]),
        "drag": 1e-3,
        "free": free,
        "q0": q0,
        "v0": 0.1 * rng.normal(size=q0.shape),
        "h": h,
        "steps": steps,
        "weights": rng.normal(size=(2, *q0.shape)),
    }


def implicit_cloth(n: int, steps: int = 10) -> dict[str, Any]:
    """The same cloth, too stiff for an explicit method: k h^2 / m is about 1e3.

    Springs so stiff buckle under a strain of m / (k h^2): then backward Euler has several solutions, and Newton's
    matrix is indefinite.  So the start is perturbed by strains of about 1e-5, whatever n: the matrix stays definite.
    """
    problem = cloth(n, steps, stiffness=1e5, h=1e-2)
    rng = np.random.default_rng(n)
    flat = np.round(problem["q0"] * (n - 1)) / (n - 1)  # the grid before `cloth` perturbed it
    problem["q0"] = flat + 1e-5 * rng.normal(size=flat.shape) / n
    problem["v0"] = 1e-3 * rng.normal(size=flat.shape) / n
    return problem


def dsim_system(problem: dict[str, Any]) -> Any:
    """The same cloth for dsim."""
    from dsim import System
    from dsim.effects import Drag, Gravity, Springs

    effects = (
        Gravity(problem["gravity"]),
        Drag(problem["drag"]),
        Springs(problem["pairs"], problem["rest"], problem["stiffness"]),
    )
    mass = np.full(len(problem["q0"]), problem["mass"])
    return System(mass, effects, fixed=np.flatnonzero(problem["free"] == 0))


def dsim_state(problem: dict[str, Any]) -> Any:
    """y0 = [q, v]."""
    return np.concatenate([problem["q0"].ravel(), problem["v0"].ravel()])
