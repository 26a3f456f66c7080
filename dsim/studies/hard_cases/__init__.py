"""Hard cases: where the naive method fails, shown next to one that survives.

model.py     HardCase, HardCaseResult, and what is drawn: plain data
springs.py   1-5: stiff, too quick, of no length, compressed; an overshooting Newton
equilibria.py 6, 7: a fold, and an equilibrium that is not a minimum
long_time.py 8, 9: energy and momenta over long times
rotation.py  10-13: a racket, a wobble, a heavy top, quaternions
chaos.py     41: a derivative that is exact and useless
gradients.py 45: the norm at 0

A further case is a function that returns a HardCaseResult, and one row of `catalog.HARD_CASES`.
"""

from dsim.studies.hard_cases.chaos import chaotic_map
from dsim.studies.hard_cases.equilibria import hinged_strut, von_mises_truss
from dsim.studies.hard_cases.gradients import norm_at_zero
from dsim.studies.hard_cases.long_time import free_net, orbit
from dsim.studies.hard_cases.model import Curve, HardCase, HardCaseResult, Panel, select
from dsim.studies.hard_cases.rotation import added_quaternions, fast_wobble, racket, spinning_top
from dsim.studies.hard_cases.springs import (
    coincident_ends,
    compressed_spring,
    edge_of_stability,
    overshooting_newton,
    stiff_spring,
)

__all__ = [
    "Curve",
    "HardCase",
    "HardCaseResult",
    "Panel",
    "added_quaternions",
    "chaotic_map",
    "coincident_ends",
    "compressed_spring",
    "edge_of_stability",
    "fast_wobble",
    "free_net",
    "hinged_strut",
    "norm_at_zero",
    "orbit",
    "overshooting_newton",
    "racket",
    "select",
    "spinning_top",
    "stiff_spring",
    "von_mises_truss",
]
