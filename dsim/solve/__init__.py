"""Solvers that know nothing of physics: Newton, linear systems."""

from dsim.solve.newton import NewtonResult, Status, newton

__all__ = ["NewtonResult", "Status", "newton"]
