"""Three verdicts on any simulator with a gradient: the program's derivative? the physics'? does it point downhill?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.studies.verdicts.descent import SIGMA, DescentVerdict, judge_descent
from dsim.studies.verdicts.physics import REFINEMENTS, PhysicsVerdict, Truth, judge_physics
from dsim.studies.verdicts.program import BlockVerdict, ProgramVerdict, judge_program
from dsim.studies.verdicts.simulator import Method, Simulator, of_system

__all__ = [
    "AuditReport",
    "BlockVerdict",
    "DescentVerdict",
    "Method",
    "PhysicsVerdict",
    "ProgramVerdict",
    "Simulator",
    "audit",
    "judge_descent",
    "judge_physics",
    "judge_program",
    "of_system",
]

GOOD = ("right", "converges", "not asked", "downhill")
UNSURE = ("kink", "jump", "noise", "unclear")


@dataclass(frozen=True, eq=False)
class AuditReport:
    """The three verdicts on one program."""

    name: str
    program: ProgramVerdict
    physics: PhysicsVerdict
    descent: DescentVerdict

    @property
    def words(self) -> tuple[str, str, str]:
        """One word a verdict."""
        return self.program.verdict, self.physics.verdict, self.descent.verdict

    @property
    def ok(self) -> bool:
        """right, converges (where asked) and downhill."""
        return all(word in GOOD for word in self.words)

    @property
    def code(self) -> int:
        """0: all three are good.  1: one is bad.  2: none is bad, but one could not be given."""
        if any(word not in GOOD + UNSURE for word in self.words):
            return 1
        return 0 if self.ok else 2

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and text, for JSON; what is not finite becomes null."""
        physics, descent = self.physics, self.descent
        blocks = {
            b.block: {"verdict": b.verdict, "digits": round(b.digits, 2), "given": _number(b.given),
                      "numerical": _number(b.numerical), "where": b.where, "first_bad_step": b.first_bad_step}
            for b in self.program.blocks
        }  # fmt: skip
        states = physics.state_error
        return {
            "name": self.name,
            "ok": self.ok,
            "program": {"verdict": self.program.verdict, "blocks": blocks},
            "physics": {"verdict": physics.verdict, "h": _numbers(physics.h),
                        "gradient_error": _numbers(physics.gradient_error),
                        "state_error": None if states is None else _numbers(states),
                        "orders": _numbers(physics.orders), "against": physics.against},
            "descent": {"verdict": descent.verdict, "t": _numbers(descent.t), "growth": _numbers(descent.growth),
                        "rate": _number(descent.rate), "digits": _number(descent.digits),
                        "slope": _number(descent.slope), "smoothed": _number(descent.slopes.smoothed),
                        "mean": _number(descent.slopes.mean), "sigma": descent.sigma},
        }  # fmt: skip

    def __str__(self) -> str:
        told = (("program", self.program), ("physics", self.physics), ("descent", self.descent))
        return "\n".join([self.name, *(f"  {label}  {verdict}" for label, verdict in told)])


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(value) for value in values]


def audit(
    simulator: Simulator,
    truth: Truth | None = None,
    *,
    refinements: Sequence[int] = REFINEMENTS,
    sigma: float = SIGMA,
    seed: int = 0,
    report: Callable[[str], None] | None = None,
) -> AuditReport:
    """Is the gradient the program's derivative; does it converge to the physics'; does it point downhill?

    truth: (x, T, w) -> (y(T), d(w . y(T))/dx) of the physics, where known; else the program's own states at small h.
    refinements: h is divided by these; () for a program that has a step of its own.  sigma: how far to smooth the
    objective, in sizes of x.  report is called with the name of each verdict before it is sought.  Raises ValueError
    on bad input or a run that does not reach its end.

    >>> from dsim import scenes, steppers
    >>> ball = scenes.projectile()
    >>> found = audit(of_system(steppers.SymplecticEuler(), ball.system, ball.y0, (0.02, 10), ["velocities", "mass"]))
    >>> found.words
    ('right', 'converges', 'downhill')
    """
    if not isinstance(simulator, Simulator):
        raise ValueError(f"simulator must be a Simulator (dsim.studies.verdicts); got {simulator!r:.60}")
    say = report or (lambda name: None)
    w = simulator.weights(seed)
    say("program")
    program = judge_program(simulator, w, seed)
    say("physics")
    physics = judge_physics(simulator, w, truth, refinements, seed)
    say("descent")
    return AuditReport(simulator.name, program, physics, judge_descent(simulator, w, sigma, seed))
