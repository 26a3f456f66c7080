"""Gradients of whole trajectories, from the steppers' own linearizations."""

from dsim.gradients.adjoint import Gradient, adjoint

__all__ = ["Gradient", "adjoint"]
