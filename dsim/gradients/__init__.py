"""Gradients of whole trajectories and of equilibria, from linearizations that are stated elsewhere."""

from dsim.gradients.adjoint import Gradient, adjoint
from dsim.gradients.quasistatic import Equilibrium, EquilibriumError, quasistatic

__all__ = ["Equilibrium", "EquilibriumError", "Gradient", "adjoint", "quasistatic"]
