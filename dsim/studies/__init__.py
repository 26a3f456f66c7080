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
from dsim.studies.verdicts import AuditReport, Simulator, audit

__all__ = [
    "AdjointReport",
    "AuditReport",
    "GradientReport",
    "JacobianReport",
    "Simulator",
    "TaylorReport",
    "audit",
    "check_adjoint",
    "check_gradient",
    "check_jacobian",
    "taylor_test",
]
