"""Hard case 41: a chaotic map, whose derivative is exact and useless beyond a horizon that can be told in advance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dsim.arrays.checks import Array
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal
from dsim.studies.horizons import ANGLE, logistic, logistic_slopes, logistic_truth
from dsim.studies.verdicts.descent import DescentVerdict, judge_descent
from dsim.studies.verdicts.simulator import Simulator

EPS = float(np.finfo(float).eps)


def chaotic_map(full: bool = False, judge: Callable[[Simulator], DescentVerdict] = judge_descent) -> HardCaseResult:
    """x -> 4 x (1 - x) from sin^2(0.3): the truth is known at every n, so the digits left can be checked.

    naive: the chain rule, trusted at any n.  survivor: `judge` tells the digits left from the growth |dx_n/dx_0|.
    """
    n = 60
    truth = logistic_truth(n)[1]
    slopes = logistic_slopes(float(np.sin(ANGLE) ** 2), n)
    error = np.abs(slopes - truth) / np.abs(truth)
    foretold = EPS * np.maximum.accumulate(np.abs(slopes))
    counts = np.arange(n + 1)
    found = {steps: judge(logistic(steps)) for steps in (10, 20, 30, 40, 60)}
    spare = [_spare(found[steps], error[: steps + 1]) for steps in (20, 30, 40)]
    return HardCaseResult(
        (
            at_least("chain rule", "relative error after 60 steps", float(error[60]), 1.0),
            at_least("chain rule", "relative error after 40 steps", float(error[38:43].max()), 1e-6),
        ),
        (
            at_most("chain rule", "relative error up to 20 steps", float(error[:21].max()), 1e-10),
            equal("verdict", '"chaotic" after 60 steps', float(found[60].verdict == "chaotic"), 1),
            at_most("verdict", "digits left after 60 steps", found[60].digits, 0.5),
            at_least("verdict", "digits left after 10 steps", found[10].digits, 11.0),
            at_most("verdict", "digits promised too many, after 20, 30, 40 steps", -min(spare), 1.0),
            at_most("verdict", "digits promised too few", max(spare), 3.0),
        ),
        (
            Panel("Naive: trusted at any n", "steps n", "relative error of dx_n/dx_0",
                  (Curve("chain rule", counts, np.maximum(error, EPS), True),), "no digit is left", "log"),
            Panel("The verdict: eps |dx_n/dx_0|", "steps n", "relative error of dx_n/dx_0",
                  (Curve("foretold by the growth", counts, foretold),
                   Curve("chain rule", counts, np.maximum(error, EPS), True)), "known in advance", "log"),
        ),
        (f"off by {error[60]:.1g} at n = 60", f"{found[40].digits:.1f} digits at n = 40, chaotic at 60",
         "n <= 20: 1e-10"),
    )  # fmt: skip


def _spare(found: DescentVerdict, error: Array) -> float:
    """Digits there are beyond those promised: by the worst error of the last steps, a single one being luck."""
    return float(-np.log10(max(error[-4:].max(), EPS)) - found.digits)
