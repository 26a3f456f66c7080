"""dsim: differentiable simulation you can read, teach from and check your own code against.

    A step is a residual; a gradient is its linearization.

`import dsim` loads NumPy alone; every name below loads its module when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dsim.gradients import Equilibrium as Equilibrium
    from dsim.gradients import EquilibriumError as EquilibriumError
    from dsim.gradients import Gradient as Gradient
    from dsim.gradients import ReducedObjective as ReducedObjective
    from dsim.gradients import Residuals as Residuals
    from dsim.gradients import Variables as Variables
    from dsim.gradients import adjoint as adjoint
    from dsim.gradients import quasistatic as quasistatic
    from dsim.gradients import sensitivity as sensitivity
    from dsim.planning import plan as plan
    from dsim.simulation import SimulationError as SimulationError
    from dsim.simulation import Trajectory as Trajectory
    from dsim.simulation import simulate as simulate
    from dsim.solve import Status as Status
    from dsim.solve import newton as newton
    from dsim.steppers.checkpoints import Checkpoints as Checkpoints
    from dsim.system import Flow as Flow
    from dsim.system import System as System

__version__ = "0.1.0"

_HOMES = {
    "Checkpoints": "dsim.steppers.checkpoints",
    "Equilibrium": "dsim.gradients",
    "EquilibriumError": "dsim.gradients",
    "Flow": "dsim.system",
    "Gradient": "dsim.gradients",
    "ReducedObjective": "dsim.gradients",
    "Residuals": "dsim.gradients",
    "SimulationError": "dsim.simulation",
    "Status": "dsim.solve",
    "System": "dsim.system",
    "Trajectory": "dsim.simulation",
    "Variables": "dsim.gradients",
    "adjoint": "dsim.gradients",
    "newton": "dsim.solve",
    "plan": "dsim.planning",
    "quasistatic": "dsim.gradients",
    "sensitivity": "dsim.gradients",
    "simulate": "dsim.simulation",
}
_MODULES = {"catalog", "effects", "gradients", "kernels", "pictures", "scenes", "simulation", "solve", "steppers",
            "strategies", "studies", "system"}  # fmt: skip

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    if name in _MODULES:
        return importlib.import_module(f"dsim.{name}")
    raise AttributeError(f"module 'dsim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES, *_MODULES})
