"""Time-stepping methods.  Begin with `euler`, which reads like the notes."""

from dsim.steppers.euler import BackwardEuler, ForwardEuler, NormalisedEuler, SymplecticEuler, TwoStepBackwardEuler
from dsim.steppers.explicit import RK4, RKMK4, VelocityVerlet
from dsim.steppers.implicit import BDF2, ImplicitMidpoint, Trapezoidal
from dsim.steppers.rule import ImplicitRuleStepper, RuleStepper
from dsim.steppers.stepper import Counters, Linearization, Step, Stepper

__all__ = [
    "BDF2",
    "RK4",
    "RKMK4",
    "BackwardEuler",
    "Counters",
    "ForwardEuler",
    "ImplicitMidpoint",
    "ImplicitRuleStepper",
    "Linearization",
    "NormalisedEuler",
    "RuleStepper",
    "Step",
    "Stepper",
    "SymplecticEuler",
    "Trapezoidal",
    "TwoStepBackwardEuler",
    "VelocityVerlet",
]
