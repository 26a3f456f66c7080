"""What every generated check returns: a verdict with the number behind it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """One verified statement: `measured` was compared with `bound` and found fit or not."""

    subject: str  # what was checked: "springs", "backward Euler", "scene: chain"
    statement: str  # what was claimed: "dq against differences of force"
    passed: bool
    measured: float
    bound: str  # the claim in figures: "<= 1e-7", "2 +- 0.1"
