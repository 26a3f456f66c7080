"""Report sections on methods: observed orders, Newton's rate, scenes and their gradients, the verdicts."""

from __future__ import annotations

import numpy as np

from dsim import catalog, scenes
from dsim.pictures import scene as scene_pictures
from dsim.pictures import verification
from dsim.pictures.gradient_check import v_curve
from dsim.pictures.style import to_png, to_svg
from dsim.report.model import Picture, Progress, Section, Table
from dsim.studies.check import Check
from dsim.studies.convergence import check_order
from dsim.studies.gradient_check import check_gradient
from dsim.studies.newton_rate import rate, solve_step
from dsim.studies.scene_gradients import check_scene, knobs

SMALL = {
    "chain": {"links": 6},
    "cloth": {"n": 4},
    "soft_body": {"floors": 3},
    "sign": {"links": 1},
}  # sizes for the gradient checks


def orders(progress: Progress) -> Section:
    """Every stepper on every order problem."""
    checks, rows, pictures = [], [], []
    for build in catalog.ORDER_PROBLEMS:
        problem, fits = build(), {}
        for stepper in catalog.STEPPERS:
            if stepper.form > problem.system.components:
                continue
            name = type(stepper).__name__
            progress(f"{problem.name}, {name}")
            check, fit = check_order(stepper, problem)
            checks.append(check)
            fits[name] = (stepper.order, fit)
            text = f"{fit.order:.3f} +- {fit.standard_error:.3f}"
            rows.append((problem.name, name, stepper.order, text, f"{fit.r_squared:.5f}", fit.error[-1]))
        alt = f"Error over step size for {len(fits)} methods on a {problem.name}: straight lines of slopes 1, 2 and 4."
        caption = f"{problem.name.capitalize()}: the error over the step size; the slope is the order."
        pictures.append(Picture(to_svg(verification.orders(fits, problem.name)), alt, caption))
    lead = (
        "Six step sizes, the largest error over twenty times, against two SciPy integrators that agree with each "
        "other to far below the smallest error shown. The slope is fitted; its standard error stands beside it."
    )
    columns = ("problem", "method", "order", "observed", "R^2", "smallest error")
    return Section(lead, tuple(checks), (Table(columns, tuple(rows)),), tuple(pictures))


def newton(progress: Progress) -> Section:
    """The quadratic rate, and its loss."""
    progress("a stiff net")
    right, wrong = solve_step(), solve_step(scale=0.99)
    checks = (
        Check("Newton", "rate with the exact Jacobian", bool(rate(right) >= 1.8), rate(right), ">= 1.8"),
        Check("Newton", "rate with a Jacobian off by 1 %", bool(rate(wrong) <= 1.3), rate(wrong), "<= 1.3"),
        Check("Newton", "iterations, exact Jacobian", right.converged, right.iterations, "converged"),
    )
    results = {"exact Jacobian": right, "force Jacobian scaled by 0.99": wrong}
    alt = "The residual falls quadratically with the exact Jacobian and only linearly with one that is 1 % off."
    figure = verification.newton_rates(results)
    picture = Picture(to_svg(figure), alt, "One backward Euler step of a stiff spring net.")
    lead = (
        "Near the solution Newton doubles the correct digits with every iteration - if the Jacobian is the derivative."
    )
    return Section(lead, checks, (), (picture,))


def scene_gradients(progress: Progress, full: bool = False) -> Section:
    """The adjoint of every scene, judged like anybody else's gradient; with `full`, in full size and over 20 steps."""
    checks, rows, pictures = [], [], []
    for build in catalog.SCENES:
        scene = build() if full else build(**SMALL.get(build.__name__, {}))
        progress(scene.name)
        few = 1 if scene.system.curved else 2  # a step of bodies takes ten times as long
        report = check_scene(scene, steps=20 if full else few)
        names = knobs(scene.system)
        stepper = type(scene.stepper).__name__
        checks.append(Check(scene.name, f"adjoint of {stepper}: {report.verdict}", report.ok, report.digits, "smooth"))
        rows.append((scene.name, stepper, len(names), report.verdict, f"{report.digits:.1f}", report.evaluations))
        if build is scenes.cloth:
            alt = "The difference between adjoint and finite differences over the step: a V with its floor far down."
            caption = "The cloth: differences against the adjoint. Truncation on the right, round-off on the left."
            pictures.append(Picture(to_svg(v_curve(report, "cloth")), alt, caption))
    pictures += _films(progress)
    lead = (
        "For each of the lecture's scenes, the gradient of an objective over all states by every kind of parameter and "
        "by the start, computed by the discrete adjoint, against differences of the whole simulation over steps "
        "from 1e-3 to 1e-10."
    )
    columns = ("scene", "stepper", "knobs", "verdict", "digits", "simulations")
    return Section(lead, tuple(checks), (Table(columns, tuple(rows)),), tuple(pictures))


def _films(progress: Progress) -> list[Picture]:
    progress("cloth, filmstrip")
    cloth = scenes.cloth()
    strip = to_png(scene_pictures.filmstrip(cloth, cloth.simulate()), dpi=120)
    progress("kepler, energy")
    kepler = scenes.kepler()
    energy = to_svg(scene_pictures.energy(kepler, kepler.simulate()))
    return [
        Picture(
            strip, "Six frames of a cloth falling and swinging from two corners.", "A hanging cloth.", "dsim show cloth"
        ),
        Picture(
            energy,
            "Kinetic, potential and total energy of a Kepler orbit.",
            "Energy over one orbit.",
            "dsim show kepler",
        ),
    ]


def verdicts(progress: Progress) -> Section:
    """What the five verdicts look like, on functions whose answer is known."""
    rng = np.random.default_rng(0)
    x = np.array([0.3, -0.2])
    cases = {
        "smooth": (lambda z: float(np.sin(z).sum()), x, np.cos(x)),
        "wrong": (lambda z: float(np.sin(z).sum()), x, np.cos(x) * [1.0, 1 + 1e-5]),
        "kink": (lambda z: float(np.abs(z).sum()), np.array([0.0, 0.5]), np.array([0.0, 1.0])),
        "jump": (lambda z: float(np.floor(z).sum()), np.array([1.0, 0.5]), np.zeros(2)),
        "noise": (lambda z: float(z.sum() + 1e-6 * rng.normal()), x, np.ones(2)),
    }
    checks, pictures = [], []
    for expected, (f, at, gradient) in cases.items():
        progress(expected)
        report = check_gradient(f, at, gradient)
        statement = f"a function known to be {expected}" if expected != "wrong" else "one entry wrong by 1e-5"
        checks.append(
            Check(
                "check_gradient", f"{statement}: {report.verdict}", report.verdict == expected, report.digits, expected
            )
        )
        if expected in ("smooth", "wrong"):
            alt = f"V-curve of a {expected} gradient." + (" It flattens at 1e-5." if expected == "wrong" else "")
            pictures.append(Picture(to_svg(v_curve(report)), alt, f"Verdict {expected}: {report.advice}"))
    lead = (
        "`dsim check` judges anybody's gradient by a sweep of steps on both sides. It answers smooth, kink, jump, "
        "noise or wrong, never just yes or no. A gradient that is off by 1e-5 in one entry is wrong."
    )
    return Section(lead, tuple(checks), (), tuple(pictures))
