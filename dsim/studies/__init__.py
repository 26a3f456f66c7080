"""Studies: what is measured about methods and gradients.  Nothing here draws."""

from dsim.studies.gradient_check import (
    AdjointReport,
    GradientReport,
    JacobianReport,
    TaylorReport,
    check_adjoint,
    check_gradient,
    check_jacobian,
    taylor_test,
)

__all__ = [
    "AdjointReport",
    "GradientReport",
    "JacobianReport",
    "TaylorReport",
    "check_adjoint",
    "check_gradient",
    "check_jacobian",
    "taylor_test",
]
