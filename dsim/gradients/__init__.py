"""Gradients of whole trajectories, from the steppers' own linearizations."""

from dsim.gradients.adjoint import Gradient, adjoint
from dsim.gradients.monolithic import BlockSystem, block_system
from dsim.gradients.objectives import ReducedObjective, Residuals, Variables
from dsim.gradients.optimisation import Optimisation, optimise
from dsim.gradients.sensitivity import sensitivities, sensitivity

__all__ = [
    "BlockSystem",
    "Gradient",
    "Optimisation",
    "ReducedObjective",
    "Residuals",
    "Variables",
    "adjoint",
    "block_system",
    "optimise",
    "sensitivities",
    "sensitivity",
]
