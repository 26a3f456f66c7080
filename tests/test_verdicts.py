"""Three verdicts on right programs, on programs that are wrong in known ways, and on closed forms."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest

from dsim import catalog, scenes
from dsim.arrays.checks import Array
from dsim.pictures.audit import verdicts as picture
from dsim.pictures.style import to_png
from dsim.report.auditing import caught
from dsim.steppers import RK4, BackwardEuler, SymplecticEuler
from dsim.studies import Simulator, audit
from dsim.studies.horizons import damped, damped_slope, logistic, logistic_state, logistic_truth, over_the_wall
from dsim.studies.peers import agreement, cloth_problem, cloth_truth, of_program, twin
from dsim.studies.planted import PlantedBug, right
from dsim.studies.smoothing import Slopes, Wall, by_quadrature, by_sampling
from dsim.studies.verdicts import ProgramVerdict, judge_descent, judge_physics, judge_program, of_system

BUGS = {bug.name: bug for bug in catalog.PLANTED}


@cache
def judged(name: str) -> ProgramVerdict:
    """Of a planted bug, once."""
    return judge_program(BUGS[name].make())


def program(
    function: Any, slope: Any, x: float = 0.5, steps: int = 8, h: float = 0.125, name: str = "map"
) -> Simulator:
    """A scalar program: function (x, steps, h) -> y, slope (x, steps, h) -> dy/dx."""
    return Simulator(
        name,
        np.array([x]),
        lambda x, steps, h: np.array([function(x[0], steps, h)]),
        lambda x, steps, h, w: w * slope(x[0], steps, h),
        h,
        steps,
    )


# First verdict: every planted bug, and no others


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_the_specimen_without_a_bug_is_right(stepper: Any) -> None:
    found = judge_program(right(stepper))
    assert found.verdict == "right" and not found.wrong and found.digits > 6
    assert str(found).startswith("right")


@pytest.mark.parametrize("name", BUGS)
def test_a_planted_bug_is_wrong_in_its_blocks_from_its_step_on(name: str) -> None:
    bug: PlantedBug = BUGS[name]
    found = judged(name)
    assert found.verdict == "wrong"
    assert {block.block: block.first_bad_step for block in found.wrong} == dict(bug.wrong)
    assert caught(bug, found)
    others = [block for block in found.blocks if block.block not in bug.wrong]
    assert all(block.verdict == "smooth" for block in others)
    first = found.wrong[0]
    assert first.first_bad_step == min(bug.wrong.values())
    assert f"{first.block} from step {first.first_bad_step}" in str(found)


@pytest.mark.parametrize("name", BUGS)
def test_a_planted_bug_leaves_the_states_alone(name: str) -> None:
    """They are wrong in the gradient only, so nobody sees them in a picture."""
    simulator = BUGS[name].make()
    good = right(BackwardEuler() if simulator.steps == 2 else SymplecticEuler())
    if simulator.x.shape == good.x.shape:
        np.testing.assert_allclose(simulator.state(simulator.x), good.state(good.x), rtol=1e-12, atol=1e-12)


def test_a_bug_that_is_not_caught_is_told() -> None:
    assert not caught(BUGS["frozen direction"], judge_program(right()))
    assert not caught(BUGS["frozen direction"], judged("guarded division"))


def test_a_bug_of_a_late_step_is_found_by_halving() -> None:
    """Wrong from step 77 on, of 100: beyond the scan, doubling and halving."""
    late = program(lambda x, n, h: np.sin(x) * n, lambda x, n, h: np.cos(x) * n + (n >= 77), steps=100)
    assert judge_program(late).blocks[0].first_bad_step == 77


def test_a_bug_in_one_entry_of_many_is_seen() -> None:
    def wrong(x: Array, steps: int, h: float, w: Array) -> Array:
        gradient = 2 * x * w[0]
        gradient[123] *= 1.001
        return gradient

    many = Simulator("many", np.linspace(1, 2, 400), lambda x, steps, h: np.array([x @ x]), wrong, 0.1, 3)
    assert judge_program(many).verdict == "wrong"


def test_a_bug_in_faint_entries_is_seen() -> None:
    """Every tenth entry counts a ten-millionth of its neighbours, and has the wrong sign; right, it changes nothing."""

    def faint(sign: float) -> Simulator:
        x, a, signs = np.linspace(1, 2, 400), np.ones(400), np.ones(400)
        a[9::10], signs[9::10] = 1e-7, sign
        return Simulator("faint", x, lambda x, steps, h: np.array([a @ np.sin(x)]),
                         lambda x, steps, h, w: w[0] * signs * a * np.cos(x), 0.1, 1)  # fmt: skip

    assert judge_program(faint(1.0)).verdict == "right"
    found = judge_program(faint(-1.0))
    assert found.verdict == "wrong" and found.blocks[0].where == "random sum of faint entries"


def test_single_precision_is_judged_by_its_own_measure() -> None:
    single = Simulator(
        "single",
        np.array([0.3, 0.7]),
        lambda x, steps, h: np.sin(x.astype(np.float32)),
        lambda x, steps, h, w: (w * np.cos(x)).astype(np.float32),
        0.1,
        1,
    )
    found = judge_program(single)
    assert found.verdict == "right" and 2 < found.digits < 8


# Second verdict


def decay(x: float, steps: int, h: float) -> float:
    return float(x * (1 - h) ** steps)


def test_a_first_order_program_converges_with_order_one() -> None:
    euler = program(decay, lambda x, n, h: (1 - h) ** n)
    found = judge_physics(euler, truth=lambda x, T, w: (x * np.exp(-T), w * np.exp(-T)))
    assert found.verdict == "converges" and abs(found.orders[0] - 1) < 0.1 and abs(found.orders[1] - 1) < 0.1
    assert judge_physics(euler).verdict == "converges"


def test_a_gradient_of_another_physics_is_astray() -> None:
    """States converge, the gradient is off by a factor at every h: no truth is needed to see it."""
    off = program(decay, lambda x, n, h: 0.9 * (1 - h) ** n)
    assert judge_physics(off, truth=lambda x, T, w: (x * np.exp(-T), w * np.exp(-T))).verdict == "astray"
    assert judge_physics(off).verdict == "astray"


def test_the_picture_shows_an_error_that_stays_as_level() -> None:
    """On an axis of the data's own range a fall by 1 % looks like convergence; a wrong block names its first step."""
    off = audit(program(decay, lambda x, n, h: 0.9 * (1 - h) ** n))
    blocks, errors, _ = picture([off]).axes
    low, high = errors.get_ylim()
    assert off.physics.verdict == "astray" and high / low > 8
    assert [text.get_text() for text in blocks.texts] == ["wrong from step 1"]


def bounce(x: float, steps: int, h: float) -> tuple[float, float]:
    """A ball at x with v = -1 m/s against a wall at 0, elastic, without a time of impact: (x_T, dx_T/dx_0)."""
    v = -1.0
    for _ in range(steps):
        v = -v if x + h * v < 0 else v
        x += h * v
    return x, 1.0


def test_a_wall_without_a_time_of_impact_is_the_programs_derivative_and_not_the_physics() -> None:
    """x_T = T - x_0, so dx_T/dx_0 = -1; the program says +1 for every h, and is right about itself."""
    wall = program(lambda x, n, h: bounce(x, n, h)[0], lambda x, n, h: bounce(x, n, h)[1], x=0.5037, steps=50, h=0.02)
    assert judge_program(wall).verdict == "right"
    assert judge_physics(wall, truth=lambda x, T, w: (T - x, -w)).verdict == "astray"
    assert judge_physics(wall).verdict == "astray"


def test_physics_that_the_states_cannot_tell_are_unclear() -> None:
    """A ripple as wide as the differences are taken: at two distances they say different things."""
    rippled = program(lambda x, n, h: x + 0.1 * np.sin(200 * x), lambda x, n, h: 1 + 20 * np.cos(200 * x))
    found = judge_physics(rippled)
    assert found.verdict == "unclear" and 0.1 < found.doubt < 1


def test_physics_need_not_be_asked() -> None:
    assert judge_physics(logistic(5), refinements=()).verdict == "not asked"


# Third verdict


def test_chaos_has_no_digits_left() -> None:
    """R8: dx_n/dx_0 = 2^n sin(2^(n+1) a)/sin(2 a), and the digits are foretold by its size."""
    assert judge_descent(logistic(60)).verdict == "chaotic"
    short = judge_descent(logistic(4), sigma=1e-4)
    assert short.verdict == "downhill" and short.digits > 14
    _, slopes = logistic_truth(30)
    found = judge_descent(logistic(30), sigma=1e-9)
    assert found.growth[-1] == pytest.approx(abs(slopes[-1]), rel=1e-6)
    assert found.rate == pytest.approx(np.log(2), abs=0.2)
    np.testing.assert_allclose(logistic_state(float(np.sin(0.3) ** 2), 20), logistic_truth(20)[0], atol=1e-9)


@pytest.mark.parametrize(
    "c, exact, euler", [(0, 0.999, 0.999), (1, 0.631437, 0.631305), (3, 0.316213, 0.315812), (10, 0.0994963, 0.098996)]
)
def test_drag_bounds_the_growth(c: float, exact: float, euler: float) -> None:
    """R9: 999 updates of 1 ms; the library's symplectic Euler is the second form."""
    assert damped_slope(c) == pytest.approx(exact, abs=6e-7)
    assert damped_slope(c, exponential=False) == pytest.approx(euler, abs=6e-7)
    particle = damped(c)
    assert particle.pulled(np.array([1.0, 0.0]))[0] == pytest.approx(damped_slope(c, exponential=False), rel=1e-12)


def test_a_ball_over_a_wall_is_biased_and_every_single_check_passes() -> None:
    """R7: smoothed slope -0.026225, mean of exact derivatives -0.000526, 98 % off."""
    wall, angle = Wall(), 0.6932038
    fine = by_quadrature(wall.line(angle), 0.1, 65539)
    assert fine.smoothed == pytest.approx(-0.026225, abs=1e-6)
    assert fine.mean == pytest.approx(-0.000526, abs=1e-6)
    assert fine.biased and fine.bias / fine.smoothed == pytest.approx(-0.98, abs=0.002)
    drawn = by_sampling(wall.line(angle), 0.1, 40_000)
    assert abs(drawn.smoothed - fine.smoothed) < 4 * drawn.smoothed_error < 1e-3
    assert abs(drawn.mean - fine.mean) < 4 * drawn.mean_error < 1e-4

    thrown = over_the_wall()
    assert judge_program(thrown).verdict == "right"
    assert judge_descent(thrown, sigma=0.1).verdict == "biased"


def test_smooth_functions_have_no_bias() -> None:
    slopes = by_quadrature(lambda s: (np.sin(0.4 + s), np.cos(0.4 + s)), 0.2)
    truth = np.cos(0.4) * np.exp(-0.02)
    assert slopes.smoothed == pytest.approx(truth, rel=1e-7) and slopes.mean == pytest.approx(truth, rel=1e-7)
    assert not slopes.biased


def test_a_gradient_that_sees_a_ripple_only_is_useless() -> None:
    """A ripple of 1e-3 m on a slope: the derivative sees the ripple only."""
    rippled = program(lambda x, n, h: x + 1e-3 * np.sin(3e4 * x), lambda x, n, h: 1 + 30 * np.cos(3e4 * x), x=1.0)
    assert judge_descent(rippled).verdict == "useless"


def test_units_do_not_count_in_the_digits() -> None:
    """The same decay in other units, in single precision too: a derivative of 1e16, and all digits are left."""
    for single in (False, True):
        scaled = program(
            lambda x, n, h, t=np.float32 if single else float: t(1e8 * decay(1e8 * x, n, h)),
            lambda x, n, h: 1e16 * (1 - h) ** n,
            x=0.5e-8,
        )
        found = judge_descent(scaled)
        assert found.verdict == "downhill" and found.growth[0] > 1e15 and found.digits > 6
    crossing = program(lambda x, n, h: x - 0.5 + 1e-13, lambda x, n, h: 1.0)  # a miss that is almost nothing
    assert judge_descent(crossing).verdict == "downhill"


def test_two_digits_are_chaos_too() -> None:
    found = judge_descent(logistic(48))
    assert 0.5 < found.digits < 3 and found.verdict == "chaotic"


def test_a_program_that_ends_nearby_is_unclear() -> None:
    """Right at x; 5 % further on there is no state."""
    ending = program(lambda x, n, h: np.sqrt(1.05 - x) if x < 1.05 else np.nan,
                     lambda x, n, h: -0.5 / np.sqrt(1.05 - x) if x < 1.05 else np.nan, x=1.0)  # fmt: skip
    found = audit(ending, refinements=())
    assert found.words == ("right", "not asked", "unclear") and found.code == 2


def test_a_bias_of_a_tenth_counts_and_one_of_a_thousandth_does_not() -> None:
    assert Slopes(1.0, 1e-9, 0.9, 1e-9).biased and not Slopes(1.0, 0.05, 0.9, 1e-9).biased
    assert not Slopes(1.0, 1e-9, 0.999, 1e-9).biased


# All three, in words


def test_dsims_own_steppers() -> None:
    ball = scenes.projectile()
    found = audit(of_system(RK4(), ball.system, ball.y0, (0.05, 10), ["velocities", "mass", "drag.coefficient"]))
    assert found.words == ("right", "converges", "downhill") and found.ok and found.code == 0
    told = json.dumps(found.to_dict(), allow_nan=False)
    assert "velocities" in told and len(str(found).splitlines()) == 4
    assert to_png(picture([found]), dpi=40).startswith(b"\x89PNG")


def test_the_code_of_a_wrong_program_and_of_one_without_a_verdict() -> None:
    off = program(decay, lambda x, n, h: 0.9 * (1 - h) ** n)
    report = audit(off)
    assert report.code == 1 and not report.ok and "wrong: x from step 1" in str(report)
    kinked = program(lambda x, n, h: abs(x - 0.5), lambda x, n, h: 0.5)
    assert audit(kinked, refinements=()).words[:2] == ("kink", "not asked")
    assert to_png(picture([report, audit(kinked, refinements=())]), dpi=40).startswith(b"\x89PNG")


def by_numpy(problem: dict[str, Any]) -> Any:
    """The cloth as another author would write it: plain loops of matrices, complex steps for the gradient."""
    i, j = problem["pairs"].T

    def forward(stiffness: Array, v0: Array) -> Any:
        q, v = problem["q0"].astype(v0.dtype), problem["free"][:, None] * v0
        for _ in range(problem["steps"]):
            edge = q[j] - q[i]
            pull = (stiffness * (1 - problem["rest"] / np.sqrt((edge**2).sum(axis=1))))[:, None] * edge
            force = problem["mass"] * problem["gravity"] - problem["drag"] * v
            np.add.at(force, i, pull)
            np.add.at(force, j, -pull)
            v = v + problem["h"] * problem["free"][:, None] * force / problem["mass"]
            q = q + problem["h"] * v
        return q, v

    def gradient(stiffness: Array, v0: Array) -> Any:
        found = []
        x = np.concatenate([stiffness, v0.ravel()]).astype(complex)
        for k in range(len(x)):
            x[k] += 1e-30j
            q, v = forward(x[: len(stiffness)], x[len(stiffness) :].reshape(v0.shape))
            found.append((problem["weights"] * np.stack([q, v])).sum().imag / 1e-30)
            x[k] -= 1e-30j
        return np.array(found[: len(stiffness)]), np.array(found[len(stiffness) :]).reshape(v0.shape)

    return forward, gradient


def test_another_program_of_the_same_cloth_agrees() -> None:
    problem = cloth_problem(n=3, steps=10)
    other, same = of_program("loops", by_numpy, problem), twin(problem)
    found = agreement(other, same)
    assert found.ok and found.gradient < 1e-12
    halved = of_program(
        "halved", lambda p: (by_numpy(p)[0], lambda k, v: [g / 2 for g in by_numpy(p)[1](k, v)]), problem
    )
    assert not agreement(halved, same).ok
    assert judge_program(same).verdict == "right"


def test_the_truth_of_the_cloth_is_known() -> None:
    problem = cloth_problem(n=3, steps=10)
    same = twin(problem)
    w = same.weights()
    coarse, fine = (cloth_truth(problem, steps)(same.x, same.duration, w) for steps in (200, 400))
    np.testing.assert_allclose(coarse[1], fine[1], rtol=0, atol=1e-6 * np.abs(fine[1]).max())


# Bad input


@pytest.mark.parametrize(
    "change, message",
    [
        ({"x": [np.nan]}, "x must be finite"),
        ({"blocks": {"a": [5]}}, "blocks['a'] must be indices from 0 to 0"),
        ({"start": ("b",)}, "start must name blocks, x; got 'b'"),
        ({"x": [1.0, 2.0], "blocks": {"a": [0]}}, "blocks must cover every entry of x; 1 lies in none"),
        ({"blocks": {"a": [0], "b": []}}, "blocks['b'] must name entries of x; got none"),
        ({"h": -1.0}, "h must be"),
        ({"steps": 0}, "steps must be"),
        ({"gradient": None}, "gradient must be callable"),
    ],
)
def test_a_simulator_says_what_is_wrong_with_it(change: dict[str, Any], message: str) -> None:
    good = program(decay, lambda x, n, h: 1.0)
    values = {name: getattr(good, name) for name in ("name", "x", "simulate", "gradient", "h", "steps")} | change
    with pytest.raises(ValueError) as error:
        Simulator(**values)
    assert message in str(error.value)


def test_what_a_program_raises_is_told() -> None:
    def raises(*arguments: Any) -> Any:
        raise RuntimeError("boom")

    with pytest.raises(ValueError, match="simulate of m raised RuntimeError: boom; where a run fails it must return"):
        audit(Simulator("m", np.ones(2), raises, lambda x, n, h, w: w, 0.1, 1))
    with pytest.raises(ValueError, match="gradient of m raised RuntimeError: boom"):
        audit(Simulator("m", np.ones(2), lambda x, n, h: x, raises, 0.1, 1))


def test_answers_of_wrong_shapes_are_told() -> None:
    with pytest.raises(ValueError, match="gradient must return the shape of x"):
        judge_program(Simulator("m", np.ones(2), lambda x, n, h: x, lambda x, n, h, w: w[:1], 0.1, 1))
    with pytest.raises(ValueError, match="simulate must return one state"):
        judge_program(Simulator("m", np.ones(2), lambda x, n, h: np.ones((2, 2)), lambda x, n, h, w: w, 0.1, 1))
    with pytest.raises(ValueError, match="simulate must reach its end at x; m gave"):
        audit(Simulator("m", np.ones(2), lambda x, n, h: x * np.nan, lambda x, n, h, w: w, 0.1, 1))
    with pytest.raises(ValueError, match="simulator must be a Simulator"):
        audit("mine")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="refinements must be"):
        judge_physics(program(decay, lambda x, n, h: 1.0), refinements=(1,))
    with pytest.raises(ValueError, match="nodes must be 1 more than a multiple of 6"):
        by_quadrature(Wall().line(0.5), 0.1, 10)
