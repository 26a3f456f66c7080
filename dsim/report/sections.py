"""The explicit list of sections of `dsim verify`, in the order in which they are read."""

from __future__ import annotations

from functools import partial

from dsim.report import derivations, methods
from dsim.report.accuracy import accuracy
from dsim.report.bodies import bodies
from dsim.report.environment import build_environment
from dsim.report.gradients import gradient_cost, gradients
from dsim.report.hard_cases import hard_cases
from dsim.report.model import SectionJob
from dsim.report.plans import plans, speed
from dsim.report.showcases import showcases


def jobs(full: bool = False) -> tuple[SectionJob, ...]:
    """Every section; `full` asks for the long studies too."""
    return (
        SectionJob("scenes", "Gradients of the scenes", partial(methods.scene_gradients, full=full), cost=16),
        SectionJob("orders", "Observed orders of accuracy", methods.orders, cost=12),
        SectionJob("accuracy", "What accuracy costs", partial(accuracy, full=full), alone=True),
        SectionJob("gradients", "Gradients of whole trajectories", partial(gradients, full=full), cost=9),
        SectionJob("gradient-cost", "What a gradient costs", partial(gradient_cost, full=full), alone=True),
        SectionJob("showcases", "Gradients put to work", partial(showcases, full=full), cost=18),
        SectionJob("steppers", "Steppers and their linearizations", partial(derivations.steppers, full=full)),
        SectionJob("derivatives", "Forces and their derivatives", partial(derivations.derivatives, full=full)),
        SectionJob("bodies", "Rigid bodies", bodies, cost=11),
        SectionJob("newton", "Newton's method", methods.newton),
        SectionJob("hard-cases", "Hard cases: the naive method and one that survives", partial(hard_cases, full=full),
                   cost=20),
        SectionJob("plans", "Only the effects a scene calls for", plans, alone=True),
        SectionJob("speed", "How the cost of a run grows", partial(speed, full=full), alone=True),
        SectionJob("verdicts", "Verdicts on gradients", methods.verdicts),
        SectionJob("environment", "Machine and arithmetic", build_environment, alone=True),
    )  # fmt: skip
