"""The first section: does this machine compute as everything after it assumes?"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.report.model import Picture, Progress, Section, Table
from dsim.studies.check import Check

LEAD = """
Every other number on this page rests on IEEE double precision and on NumPy's and SciPy's linear algebra.
So the machine comes first: the spacing of numbers near 1, small numbers that are not flushed to zero,
sums, products and solves against exact answers.

The picture shows why a gradient is not checked with one difference alone. The error of a difference
quotient falls with its step until rounding takes over; a complex step has no such valley. A gradient check
can promise no more digits than the bottom of these curves.
"""


def build_environment(progress: Progress) -> Section:
    """Computed checks of the arithmetic, and the valley of finite differences."""
    progress("arithmetic")
    arithmetic = (_spacing(), _subnormal(), _summation(), _product(), _dense_solve(), _sparse_solve())
    progress("differences")
    steps = np.logspace(-16, -1, 61)
    errors = difference_errors(steps)
    rows = tuple((name, float(error.min()), float(steps[error.argmin()])) for name, error in errors.items())
    return Section(
        LEAD,
        checks=arithmetic + _difference_checks(errors),
        tables=(Table(("difference", "smallest relative error", "at step"), rows, "Best step of each difference"),),
        pictures=(_picture(steps, errors),),
    )


def difference_errors(steps: Array) -> dict[str, Array]:
    """Relative error of d/dx exp(x) sin(x) at x = 1 for each step h, by three differences."""
    x, h = 1.0, steps

    def f(z: Any) -> Any:
        return np.exp(z) * np.sin(z)

    exact = math.exp(x) * (math.sin(x) + math.cos(x))
    quotients = {
        "forward": (f(x + h) - f(np.array(x))) / h,
        "central": (f(x + h) - f(x - h)) / (2 * h),
        "complex step": np.imag(f(x + 1j * h)) / h,
    }
    return {name: np.abs(quotient / exact - 1) for name, quotient in quotients.items()}


def _difference_checks(errors: dict[str, Array]) -> tuple[Check, ...]:
    # theory: sqrt(eps) = 1.5e-8, eps^(2/3) = 4e-11, eps = 2e-16, each with its constant
    bounds = {"forward": 1e-7, "central": 1e-9, "complex step": 1e-15}
    return tuple(
        _at_most(name, "relative error of a derivative at the best step", float(errors[name].min()), bound)
        for name, bound in bounds.items()
    )


def _picture(steps: Array, errors: dict[str, Array]) -> Picture:
    from dsim.pictures.differences import valley  # matplotlib loads only when a page is made

    alt = (
        "Relative error of a derivative against the step, both logarithmic. Forward and central differences "
        "fall and then rise again as the step shrinks; the complex step falls to rounding error and stays."
    )
    return Picture(
        valley(steps, errors),
        alt,
        "Derivative of exp(x) sin(x) at x = 1 by differences. Exact results are drawn at 1e-17.",
    )


def _spacing() -> Check:
    eps = 1.0
    while 1.0 + eps / 2 != 1.0:
        eps /= 2
    return Check("float64", "spacing of the numbers above 1", eps == 2.0**-52, eps, "2^-52")


def _subnormal() -> Check:
    smallest = float(np.ldexp(np.ones(4), -1000)[0] * np.ldexp(1.0, -74))
    return Check("float64", "numbers below 1e-308 are kept", smallest == math.ldexp(1.0, -1074), smallest, "2^-1074")


def _summation() -> Check:
    values = np.random.default_rng(0).uniform(0.0, 1.0, 100_000)
    exact = math.fsum(values)
    return _at_most("numpy", "sum of 1e5 numbers against exact summation", abs(values.sum() / exact - 1), 1e-14)


def _product() -> Check:
    a = np.random.default_rng(1).integers(-1000, 1000, (60, 60))
    wrong = int(np.count_nonzero(a.astype(float) @ a.astype(float) != a @ a))
    return Check("numpy", "entries of a 60x60 product unlike whole-number arithmetic", wrong == 0, wrong, "= 0")


def _dense_solve() -> Check:
    a = np.random.default_rng(2).normal(size=(80, 80))
    b = a @ np.ones(80)
    x = np.linalg.solve(a, b)
    backward = np.linalg.norm(a @ x - b) / (np.linalg.norm(a) * np.linalg.norm(x))
    return _at_most("numpy", "backward error of a dense solve, 80 unknowns", float(backward), 1e-15)


def _sparse_solve() -> Check:
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    n = 1000
    a = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n), format="csc")
    i = np.arange(1, n + 1)
    exact = i * (n + 1 - i) / 2  # solves -x'' = 1 on the grid, in whole and half numbers
    x = splu(a).solve(np.ones(n))
    error = np.abs(x / exact - 1).max()  # condition number 4e5
    return _at_most("scipy", "error of a sparse solve, 1000 unknowns, against its closed form", float(error), 1e-10)


def _at_most(subject: str, statement: str, measured: float, bound: float) -> Check:
    return Check(subject, statement, measured <= bound, measured, f"<= {bound:g}")
