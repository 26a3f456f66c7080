"""Gradients of whole trajectories and of equilibria, from linearizations that are stated elsewhere."""

from dsim.gradients.adjoint import Gradient, adjoint
from dsim.gradients.monolithic import BlockSystem, block_system
from dsim.gradients.objectives import ReducedObjective, Residuals, Variables
from dsim.gradients.optimisation import Optimisation, optimise
from dsim.gradients.quasistatic import Equilibrium, EquilibriumError, quasistatic
from dsim.gradients.second_order import (
    Linearizations,
    gauss_newton_product,
    hessian_product,
    jacobian_product,
    jacobian_transposed,
)
from dsim.gradients.sensitivity import sensitivities, sensitivity

__all__ = [
    "BlockSystem",
    "Equilibrium",
    "EquilibriumError",
    "Gradient",
    "Linearizations",
    "Optimisation",
    "ReducedObjective",
    "Residuals",
    "Variables",
    "adjoint",
    "block_system",
    "gauss_newton_product",
    "hessian_product",
    "jacobian_product",
    "jacobian_transposed",
    "optimise",
    "quasistatic",
    "sensitivities",
    "sensitivity",
]
