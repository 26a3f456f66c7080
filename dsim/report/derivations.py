"""Report sections on the catalog: derivatives of kernels and effects, linearizations of steppers."""

from __future__ import annotations

from collections.abc import Sequence

from dsim import catalog
from dsim.pictures import verification
from dsim.pictures.style import to_svg
from dsim.report.model import Picture, Progress, Section, Table
from dsim.studies.check import Check
from dsim.studies.derivatives import check_effect, check_kernel
from dsim.studies.steps import check_stepper, everything, river


def derivatives(progress: Progress, full: bool = False) -> Section:
    """Every kernel and every effect; with `full`, at five random places instead of one."""
    checks: list[Check] = []
    for seed in range(5 if full else 1):
        for kernel in catalog.KERNELS:
            progress(f"kernel {kernel.name}")
            checks += check_kernel(kernel, seed)
        for example in catalog.EFFECTS:
            progress(example.name)
            checks += check_effect(example, seed)
    lead = (
        "Each force states its own derivatives. Here every one of them is held against extrapolated differences "
        "of what it derives from, in two and three dimensions, at points in general position. The matrix-free "
        "product `vjp`, which the adjoint uses, is held against the same differences."
    )
    return Section(lead, tuple(checks), (_worst(checks),), (_digits(checks, "derivative"),))


def steppers(progress: Progress, full: bool = False) -> Section:
    """Every stepper on a system with all effects, and on a flow where it applies; with `full`, also in 3-D."""
    checks: list[Check] = []
    systems = [everything(2), *([everything(3), everything(1)] if full else [])]
    for stepper in catalog.STEPPERS:
        progress(type(stepper).__name__)
        for problem in [*systems, river()] if stepper.form == 1 else systems:
            checks += check_stepper(stepper, problem)
    lead = (
        "A step is a residual R(y1; y0, theta) = 0 and its gradient is the linearization A dy1 + B dy0 + C dtheta = 0. "
        "A, B and C are held against differences of the residual; the fast tangent, which eliminates positions, "
        "against the plain -A^-1 (B dy0 + C dtheta); the pullback against the tangent by the dot product; "
        "and the remainder of the tangent must fall with the square of the step: slope 2."
    )
    return Section(lead, tuple(checks), (_worst(checks),), (_digits(checks, "linearization"),))


def _worst(checks: Sequence[Check]) -> Table:
    """For every statement, the worst of all its subjects."""
    rows = []
    for statement in dict.fromkeys(check.statement for check in checks):
        same = [check for check in checks if check.statement == statement]
        worst = max(same, key=lambda check: abs(check.measured - (2 if check.bound.startswith("2") else 0)))
        rows.append((statement, len(same), worst.subject, worst.measured, worst.bound))
    return Table(("statement", "checks", "worst in", "measured", "bound"), tuple(rows), "The worst of each kind.")


def _digits(checks: Sequence[Check], noun: str) -> Picture:
    figure = verification.digits([c for c in checks if c.bound.startswith("<=")])
    red = sum(not check.passed for check in checks)
    alt = f"Dots for {len(checks)} checks by their error, on a scale of powers of ten; {red} beyond their bound."
    return Picture(to_svg(figure), alt, f"The error of every {noun}; the bar is the bound it must stay below.")
