"""Free bodies in MuJoCo, semi-implicit Euler: the positions, attitudes and velocities after some steps.

MuJoCo's free joint turns by the exponential map with the angular velocity in the body's frame, as dsim's symplectic
Euler does, and its bias force holds the gyroscopic term.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def model(moments: Any, mass: Any, h: float) -> Any:
    """B bodies of these principal moments (B,3), each with a free joint, nothing else and no gravity."""
    import mujoco

    bodies = "".join(
        f'<body><freejoint/><inertial pos="0 0 0" mass="{m!r}" diaginertia="{a!r} {b!r} {c!r}"/></body>'
        for m, (a, b, c) in zip(np.asarray(mass).tolist(), np.asarray(moments).tolist(), strict=True)
    )
    option = f'<option timestep="{h!r}" gravity="0 0 0" integrator="Euler"><flag contact="disable"/></option>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{bodies}</worldbody></mujoco>")


def make(problem: dict[str, Any]) -> Callable[[], Any]:
    """A run of problem["steps"] from problem["q"] (B,7) and problem["v"] (B,6): () -> (q, v) at the end."""
    import mujoco

    made = model(problem["moments"], problem["mass"], problem["h"])
    data = mujoco.MjData(made)

    def run() -> Any:
        mujoco.mj_resetData(made, data)
        data.qpos[:], data.qvel[:] = problem["q"].ravel(), problem["v"].ravel()
        for _ in range(problem["steps"]):
            mujoco.mj_step(made, data)
        return data.qpos.reshape(-1, 7).copy(), data.qvel.reshape(-1, 6).copy()

    return run
