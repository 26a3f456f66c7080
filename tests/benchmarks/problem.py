"""The benchmark's cloth: n x n points, structural and shear springs as a plain edge list, one pinned edge."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.studies.peers import cloth_problem, state_of, system_of

dsim_system, dsim_state = system_of, state_of


def cloth(n: int, steps: int = 200, stiffness: float = 500.0, h: float = 1e-3) -> dict[str, Any]:
    """Arrays alone, so that every simulator can take them.  Mass 0.01 kg a point, gravity, drag."""
    return cloth_problem(n, steps, stiffness, h)


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
