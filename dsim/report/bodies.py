"""Rigid bodies in the report: the racket that flips, what each method keeps, orders, and effects with derivatives."""

from __future__ import annotations

import numpy as np

from dsim import catalog
from dsim.arrays.checks import Array
from dsim.pictures import rigid as drawn
from dsim.pictures.style import to_png
from dsim.report.model import Picture, Progress, Section, Table
from dsim.simulation import Trajectory, record
from dsim.steppers import ImplicitMidpoint
from dsim.studies.bodies import check_body_effect
from dsim.studies.body_problems import free_top, world_momentum
from dsim.studies.check import Check
from dsim.studies.hard_cases import rotation as cases
from dsim.studies.hard_cases.model import at_most
from dsim.studies.problems import Problem

ROUND_OFF = 1e-12  # relative, what a method that keeps L in the world may lose of it
KEEPERS = ("ImplicitMidpoint",)  # methods that promise to keep energy and momentum
STEPS = 64, 128


def bodies(progress: Progress) -> Section:
    """The flip, conserved quantities and observed orders of every stepper that turns, checks of every effect."""
    progress("a racket")
    first, between, run, found = flips()
    error = float(np.abs(found - first - between * np.arange(len(found))).max() / between)
    checks = [at_most("racket, implicit midpoint", "error of the flips, relative", error, 2e-4)]
    rows = []
    for stepper in catalog.BODY_STEPPERS:
        progress(type(stepper).__name__)
        row, kept = measured(free_top(), stepper)
        rows.append(row)
        checks += kept
    for example in catalog.BODY_EFFECTS:
        progress(example.name)
        checks += check_body_effect(example)
    lead = (
        "A body is seven numbers for its place and six for its motion; a step turns it by a rotation map, and its "
        "gradient goes through the same map. Thrown about its middle axis a racket turns over, at times that are "
        "elliptic integrals. Free bodies keep energy and angular momentum in the world: implicit midpoint with "
        "Cayley's map keeps both to round-off, the others as far as the table says."
    )
    columns = ("method", "turns by", "order", "observed", "energy drift", "drift of L", "error")
    alt = "A film of a racket that turns over twice, and its middle spin with the computed times of the flips."
    caption = f"Moments 1, 2, 3 kg m²: the flips come every {between:.4f} s, by an elliptic integral."
    picture = Picture(to_png(drawn.flip(cases.free_body(cases.RACKET, cases.TOSSED)[0], run.t, run.y, found), dpi=100),
                      alt, caption, "dsim hard-cases 10")  # fmt: skip
    return Section(lead, tuple(checks), (Table(columns, tuple(rows)),), (picture,))


def flips(h: float = 0.08) -> tuple[float, float, Trajectory, Array]:
    """(first flip, time between flips, a run, its flips)."""
    first, between = cases.intermediate_axis(cases.RACKET, cases.TOSSED)
    system, y0 = cases.free_body(cases.RACKET, cases.TOSSED)
    run = record(ImplicitMidpoint(tol=1e-13), system, y0, h, round(40 / h))
    return first, between, run, cases.crossings(run.t, cases.spins(run)[:, 1])


def measured(problem: Problem, stepper: object) -> tuple[tuple[str | int | float, ...], list[Check]]:
    """A row of the table, and the checks of the order and, where it is promised, of what is kept."""
    name, order = type(stepper).__name__, int(getattr(stepper, "order", 0))
    runs = [record(stepper, problem.system, problem.y0, problem.duration / n, n) for n in STEPS]  # type: ignore[arg-type]
    errors = [problem.state_error(run.t, run.y) for run in runs]
    observed = float(np.log2(errors[0] / errors[1]))
    energy = np.array([problem.system.energy(0.0, y) for y in runs[1].y])
    momentum = np.array([world_momentum(problem.system, y)[0] for y in runs[1].y])  # type: ignore[arg-type]
    lost = float(np.abs(energy / energy[0] - 1).max())
    turned = float(np.abs(momentum - momentum[0]).max() / np.linalg.norm(momentum[0]))
    checks = [Check(name, "observed order on a free top", abs(observed - order) <= 0.3, observed, f"{order} +- 0.3")]
    if name in KEEPERS:
        checks += [
            at_most(name, "drift of the energy", lost, ROUND_OFF),
            at_most(name, "drift of L", turned, ROUND_OFF),
        ]
    rotation = str(getattr(stepper, "rotation", ""))
    return (name, rotation, order, f"{observed:.2f}", f"{lost:.0e}", f"{turned:.0e}", errors[1]), checks
