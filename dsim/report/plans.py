"""Sections of the report: what the scenes' plans switch on and off, and how the cost of a run grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dsim import catalog
from dsim.pictures import plan as pictures
from dsim.pictures.style import to_svg
from dsim.planning import Plan, plan
from dsim.report.model import Picture, Progress, Section, Table
from dsim.scenes import Scene
from dsim.simulation import record
from dsim.steppers.stepper import Counters
from dsim.studies import growth
from dsim.studies.check import Check
from dsim.studies.effect_cost import pay_back
from dsim.system import System

STEPS = 3  # of each scene: counts of a step do not change
SHOWN = "soft_body"  # the scene of the pay-back table


def plans(progress: Progress) -> Section:
    """Every scene's plan, held against what a few steps really took; one scene's pay-back."""
    made, checks, rows = {}, list[Check](), []
    for build in catalog.SCENES:
        scene = build()
        progress(scene.name)
        made[scene.name] = plan(scene.system, scene.stepper, scene.y0, scene.h)
        counters = record(scene.stepper, scene.system, scene.y0, scene.h, STEPS).counters
        checks += plan_checks(scene, made[scene.name], counters)
        off = [line.stage for line in made[scene.name].lines if line.state == "off"]
        actual = counters.forces / STEPS
        name = type(scene.stepper).__name__
        rows.append((scene.name, name, made[scene.name].predicted.forces, actual, ", ".join(off)))
    progress("leaving out one effect after another")
    scene = next(build() for build in catalog.SCENES if build.__name__ == SHOWN)
    costs = pay_back(replace(scene, steps=20), rounds=3)
    words = tuple((row.effect, row.cost, f"{row.change:.1%}" if row.change < 1e9 else "fails") for row in costs)
    tables = (
        Table(("scene", "stepper", "forces", "actual", "off"), tuple(rows), "Force calls a step, planned and actual"),
        Table(("effect", "time with / without", "change of the end"), words, f"{SHOWN}: what an effect pays back"),
    )
    first = f"{len(made)} scenes; a disc where a stage runs, a ring where the plan says why it does not."
    alt = f"Scatter of {len(costs)} effects: time ratio against the change that leaving the effect out makes."
    drawn = (
        Picture(to_svg(pictures.overview(made)), first, "What each scene evaluates.", "dsim plan SCENE"),
        Picture(to_svg(pictures.pay_back(SHOWN, costs)), alt, "Upper left pays back most.", f"dsim plan {SHOWN}"),
    )
    lead = (
        "The scene's data choose what is simulated: a plan looks at them once, and `simulate` evaluates nothing else. "
        "Planned counts stand beside those of a run; what is off must have counted nothing. `dsim plan` prints one."
    )
    return Section(lead, tuple(checks), tables, drawn, command="dsim plan SCENE")


def plan_checks(scene: Scene, made: Plan, counters: Counters) -> list[Check]:
    """Counts as planned; nothing counted for a stage that is off; a warning beyond the stable step."""
    planned, actual = STEPS * made.predicted.forces, counters.forces
    agree = actual >= planned if made.implicit else actual == planned
    checks = [Check(scene.name, "force calls", agree, actual, f"{'>=' if made.implicit else '=='} {planned}")]
    off = {line.stage for line in made.lines if line.state == "off"}
    if "Jacobians, factorization" in off:
        idle = counters.jacobians + counters.factorizations + counters.solves
        checks.append(Check(scene.name, "Jacobians and factorizations while off", idle == 0, idle, "== 0"))
    else:
        within = counters.factorizations <= counters.newton_iterations
        bound = f"<= {counters.newton_iterations} iterations"
        checks.append(Check(scene.name, "factorizations", within, counters.factorizations, bound))
    if isinstance(scene.system, System) and 0 < getattr(scene.stepper, "frequency_limit", 0) < float("inf"):
        wild = plan(scene.system, scene.stepper, scene.y0, 1e3 * scene.h)
        if scene.system.having("dq") and not any(hasattr(e, "at") for e in scene.system.effects):
            found = len(wild.warnings)
            checks.append(Check(scene.name, "warnings at 1000 h", found >= 1, found, ">= 1"))
    return checks


def speed(progress: Progress, full: bool = False) -> Section:
    """Exponents of time and memory; the comparison with other simulators is a benchmark of its own."""
    steps = (25, 50, 100, 200)
    found = []
    for kind in growth.KINDS:
        progress(kind)
        implicit = kind == "implicit run"
        sizes = tuple((2 if full else 1) * n for n in ((8, 16, 24) if implicit else (12, 24, 48)))
        few = 3 if implicit else 50
        counts = tuple(count // 10 for count in steps) if implicit else steps
        repeats = 3 if full else 1
        found.append(growth.measure(kind, "unknowns", [(n, few) for n in sizes], repeats))
        found.append(growth.measure(kind, "steps", [(sizes[1], count) for count in counts], repeats))
    columns = ("run", "varied", "from", "to", "time ~", "memory ~")
    rows = tuple(
        (row.kind, row.varied, int(row.amounts[0]), int(row.amounts[-1]), row.time_exponent, row.memory_exponent)
        for row in found
    )
    caption = "Cost ~ amount ^ exponent, on a cloth.  Seconds are shown, not judged; memory is."
    alt = "Log-log lines of seconds over unknowns and over steps for three kinds of run."
    drawn = Picture(to_svg(pictures.growth(found)), alt, "Flat at the left: the overhead of a step in Python.")
    lead = (
        "How the cost of a run grows. Explicit runs and their adjoints are linear in both; an implicit step's band "
        "Cholesky costs n^2 on a cloth with n unknowns. `tests/benchmarks` compares with other simulators."
    )
    return Section(lead, tuple(growth_checks(found)), (Table(columns, rows, caption),), (drawn,))


def growth_checks(found: Sequence[growth.Growth]) -> list[Check]:
    """Memory is linear in unknowns and steps; a band's grows with the power 3/2 of the unknowns."""
    checks = []
    for row in found:
        bound = 1.6 if row.kind == "implicit run" else 1.1
        statement, power = f"memory over {row.varied}, exponent", row.memory_exponent
        checks.append(Check(row.kind, statement, power <= bound, power, f"<= {bound}"))
    return checks
