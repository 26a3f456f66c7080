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

    def __str__(self) -> str:
        """
        >>> print(Check("springs 2-D", "dq of the force", True, 3.2e-9, "<= 1e-07"))
        pass  springs 2-D: dq of the force; 3.2e-09, must be <= 1e-07
        """
        word = "pass" if self.passed else "FAIL"
        return f"{word}  {self.subject}: {self.statement}; {self.measured:.2g}, must be {self.bound}"
