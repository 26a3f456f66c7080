"""What a hard case is: a set-up on which the naive method fails, the failure shown, and the method that survives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array
from dsim.studies.check import Check

Scale = Literal["linear", "log"]


@dataclass(frozen=True, eq=False)
class Curve:
    """One curve to draw: x and y (n,), as a line or as points; not finite entries are left out."""

    label: str
    x: NDArray[Any]
    y: NDArray[Any]
    points: bool = False


@dataclass(frozen=True, eq=False)
class Panel:
    """One half of a picture.  x, y: axis labels with units.  contours: x (n,), y (m,) and heights (m,n) to draw below.

    note: what the reader should see, one line inside the panel.  equal: the same scale on both axes.
    """

    title: str
    x: str
    y: str
    curves: tuple[Curve, ...]
    note: str = ""
    scale: Scale = "linear"  # of the y axis
    contours: tuple[Array, Array, Array] | None = None
    equal: bool = False


@dataclass(frozen=True, eq=False)
class HardCaseResult:
    """What one case gave.

    naive: checks that the failure was reproduced.  survivor: checks against the thresholds.  panels: the naive
    method's picture and the survivor's.  figures: (naive figure, survivor figure, threshold), short texts.
    """

    naive: tuple[Check, ...]
    survivor: tuple[Check, ...]
    panels: tuple[Panel, Panel]
    figures: tuple[str, str, str]

    @property
    def checks(self) -> tuple[Check, ...]:
        return (*self.naive, *self.survivor)

    @property
    def ok(self) -> bool:
        """The failure was reproduced, and the survivor met every threshold."""
        return all(check.passed for check in self.checks)

    @property
    def verdict(self) -> str:
        """In a word; a survivor that fails weighs more than a failure that does not show."""
        if not all(check.passed for check in self.survivor):
            return "FAILS"
        return "survives" if self.ok else "no failure"

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON data; what is not finite becomes null, for JSON has no NaN."""
        return {
            "verdict": self.verdict,
            "figures": dict(zip(("naive", "survivor", "threshold"), self.figures, strict=True)),
            "naive": [_check(check) for check in self.naive],
            "survivor": [_check(check) for check in self.survivor],
            "panels": [_panel(panel) for panel in self.panels],
        }


@dataclass(frozen=True, eq=False)
class HardCase:
    """A row of `catalog.HARD_CASES`.  number: in the list of cases; setup and truth: one sentence each.

    run(full=False) -> HardCaseResult; full asks for the long version.  Further keywords of `run` replace the surviving
    method, so that a test can put a worse one in its place and see the case turn red.
    """

    number: int
    title: str
    setup: str
    truth: str
    run: Callable[..., HardCaseResult]


def select(cases: Sequence[HardCase], numbers: Sequence[int]) -> tuple[HardCase, ...]:
    """The cases with these numbers, in the catalog's order; all of them if none is given.  Raises ValueError."""
    known = [case.number for case in cases]
    for number in numbers:
        if number not in known:
            raise ValueError(f"N must be one of {', '.join(map(str, known))}; got {number}")
    return tuple(case for case in cases if case.number in numbers or not numbers)


# Checks


def at_most(subject: str, statement: str, measured: float, bound: float) -> Check:
    """measured <= bound; NaN is not."""
    return Check(subject, statement, bool(measured <= bound), float(measured), f"<= {bound:g}")


def at_least(subject: str, statement: str, measured: float, bound: float) -> Check:
    """measured >= bound; NaN is not."""
    return Check(subject, statement, bool(measured >= bound), float(measured), f">= {bound:g}")


def near(subject: str, statement: str, measured: float, target: float, tolerance: float) -> Check:
    """|measured - target| <= tolerance."""
    passed = bool(abs(measured - target) <= tolerance)
    return Check(subject, statement, passed, float(measured), f"{target:.6g} +- {tolerance:.2g}")


def equal(subject: str, statement: str, measured: float, target: float) -> Check:
    """A count, a truth value (0 or 1) or another number that must be met exactly."""
    return Check(subject, statement, bool(measured == target), float(measured), f"= {target:g}")


def thinned(array: NDArray[Any], most: int = 1500) -> NDArray[Any]:
    """At most about `most` rows at equal strides: a picture cannot show more."""
    return array[:: max(1, -(-len(array) // most))]


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _check(check: Check) -> Mapping[str, Any]:
    return asdict(check) | {"measured": _finite(check.measured), "passed": bool(check.passed)}


def _panel(panel: Panel) -> Mapping[str, Any]:
    def series(values: NDArray[Any]) -> list[float | None]:
        return [_finite(value) for value in values]

    curves = [{"label": c.label, "x": series(c.x), "y": series(c.y)} for c in panel.curves]
    return {"title": panel.title, "x": panel.x, "y": panel.y, "note": panel.note, "curves": curves}
