"""What gradients cost and how they converge: the laws, the truth, the pictures, the command and the section."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from typer.testing import CliRunner

from dsim.cli import app
from dsim.effects import Drag, Gravity
from dsim.gradients import adjoint, block_system, sensitivity
from dsim.pictures import block_system as spy_plot
from dsim.pictures import gradients as pictures
from dsim.report import accuracy, gradient_cost, gradients
from dsim.simulation import simulate
from dsim.steppers import BDF2, RK4, BackwardEuler, TwoStepBackwardEuler
from dsim.studies import gradient_cost as cost
from dsim.studies import gradient_order as order
from dsim.studies import three_ways as ways
from dsim.studies.cells import Store
from dsim.studies.check import Check
from dsim.studies.problems import adjoint_equation, solution
from dsim.studies.reference import Reference
from dsim.studies.work_precision import Study, work_precision
from dsim.system import System

NET = cost.Net(points=5, steps=4)
COUNTED = cost.Sweep((1, 10, 30), rounds=0, samples=2)


@lru_cache(maxsize=1)
def counted() -> cost.CostStudy:
    return cost.gradient_cost(NET, COUNTED)


@lru_cache(maxsize=1)
def converged() -> dict[str, Study]:
    return gradient_cost.orders(True, Store(), lambda text: None)


def red(checks: Any) -> list[str]:
    return [f"{check.subject}: {check.statement}" for check in checks if not check.passed]


# Cost


def test_passes_are_those_of_the_laws() -> None:
    study = counted()
    assert not red(cost.cost_checks(study))
    passes = {m: tuple(cell.passes for cell in study.of(m)) for m in study.methods}
    assert passes == {
        "forward difference": (2, 11, 31),
        "central difference": (2, 20, 60),
        "complex step": (1, 10, 30),
        "sensitivity": (2, 11, 31),
        "adjoint": (2, 2, 2),
    }


def test_differences_lose_digits_and_the_others_none() -> None:
    for k in (1, 30):
        found = cost.errors(NET, k, samples=k)
        assert found["forward difference"] < 1e-5 and found["central difference"] < 1e-7
        assert max(found[name] for name in cost.BOUNDS) < 1e-12


def test_groups_share_the_springs() -> None:
    """The sum over k groups is the derivative by one common factor."""
    whole = cost.by_adjoint(NET, np.ones(1), np.arange(1), cost.Work())
    parts = cost.by_adjoint(NET, np.ones(7), np.arange(7), cost.Work())
    assert parts.sum() == pytest.approx(whole[0], rel=1e-12)
    with pytest.raises(ValueError, match="k must be from 1 to 72, the number of springs; got 73"):
        NET.groups(73)
    with pytest.raises(ValueError, match="steps must be"):
        cost.Net(steps=1)


@pytest.mark.parametrize("columns", [1, 4, 256])
def test_sensitivities_in_portions(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = cost.by_adjoint(NET, np.ones(10), np.arange(10), cost.Work())
    monkeypatch.setattr(cost, "COLUMNS", columns)
    found = cost.forward_sensitivity(NET, np.ones(10), np.arange(10), cost.Work())
    np.testing.assert_allclose(found, expected, rtol=1e-11)


def test_an_inexact_adjoint_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = cost.by_adjoint
    monkeypatch.setitem(cost.METHODS, "adjoint", lambda *a: exact(*a) * (1 + 1e-10))
    assert red(cost.cost_checks(cost.gradient_cost(NET, COUNTED))) == ["adjoint: error of the gradient"]


def test_an_adjoint_a_parameter_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(net: Any, p: Any, entries: Any, work: cost.Work) -> Any:
        work.sweeps += len(entries)
        return cost.by_adjoint(net, p, entries, work)

    monkeypatch.setitem(cost.METHODS, "adjoint", slow)
    assert red(cost.cost_checks(cost.gradient_cost(NET, COUNTED))) == ["adjoint: passes ~ parameters ^"]


def test_a_plain_program_of_another_motion_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = cost.Net.plain
    monkeypatch.setattr(cost.Net, "plain", lambda net, p, kind=float: plain(net, p, kind) * (1 + 1e-9))
    found = red(cost.cost_checks(cost.gradient_cost(NET, COUNTED)))
    assert "plain program: J as dsim has it" in found and "adjoint: error of the gradient" in found


def test_what_is_over_the_limit_is_not_run_but_judged() -> None:
    study = cost.gradient_cost(NET, replace(COUNTED, most=12))
    ran = {m: [cell.parameters for cell in study.of(m) if cell.ran] for m in study.methods}
    assert ran["adjoint"] == [1, 10, 30] and ran["complex step"] == [1, 10]
    assert study.cost("complex step", 30) == (30.0, False) and study.cost("adjoint", 30) == (2.0, True)
    assert all(np.isfinite(cell.error) for cell in study.cells)
    text = gradient_cost.cost_tables(study)[0].rows[-1]
    assert text == (30, "~31", "~60", "~30", "~31", "2")
    first = replace(study, cells=tuple(c for c in study.cells if c.parameters == 1))
    assert np.isnan(first.cost("adjoint", 30)[0]) and np.isnan(first.growth("adjoint"))


def test_no_seconds_no_limit_of_seconds() -> None:
    """A method that was stopped stays so, and the limit is one of seconds where seconds are taken."""
    cell = cost.Cell("adjoint", 1, 0.0, 2, 1.0)
    grown = [cell, replace(cell, parameters=10, seconds=10.0)]
    assert not cost._affordable("adjoint", 100, cost.Sweep(limit=50), grown)
    assert cost._affordable("adjoint", 100, cost.Sweep(limit=200), grown)
    assert cost._affordable("adjoint", 100, cost.Sweep(limit=50, rounds=0), grown)
    assert not cost._affordable("adjoint", 100, cost.Sweep(), [replace(cell, passes=0)])


def test_seconds_are_taken_and_kept(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    net, sweep = cost.Net(points=3, steps=2), cost.Sweep((1, 3), rounds=1, samples=1)
    study = cost.gradient_cost(net, sweep, Store(tmp_path))
    assert study.unit == "seconds" and all(cell.seconds > 0 and cell.ran for cell in study.cells)
    json.dumps(study.to_dict(), allow_nan=False)
    monkeypatch.setattr(cost, "errors", lambda *a: pytest.fail("measured again"))
    assert cost.gradient_cost(net, sweep, Store(tmp_path)) == study


def test_derivatives_by_mass_and_drag_stay_sparse() -> None:
    """Two entries a row however many points there are: not n x N numbers a step."""
    count = 2000
    rng = np.random.default_rng(0)
    for effect in (Gravity([0.3, -9.81]), Drag(rng.uniform(size=count), wind=[1.0, -0.5])):
        bound: Any = System(np.ones(count), [effect], dimension=2).effects[0]
        q, v = rng.normal(size=(2, 2 * count))
        assert bound.dtheta(0.0, q, v).nnz == 2 * (2 * count)


# Convergence


def test_the_marble_in_closed_form_agrees_with_an_integrator() -> None:
    problem, reference = order.marble_in_a_bowl(), Reference("DOP853", 1e-9)
    numerical = solution(problem, reference)
    for t in np.linspace(0, problem.duration, 9):
        assert problem.exact is not None
        np.testing.assert_allclose(problem.exact(t), numerical(t), atol=1e-7)
    gradient = adjoint_equation(problem, reference, problem.exact(problem.duration))
    np.testing.assert_allclose(problem.truth().gradient, gradient, rtol=1e-7)


def slack(y0: Any, t: float) -> Any:
    """On the band until x = 0, then straight on."""
    crossing = np.arctan2(y0[0], -y0[1])
    speed = -np.hypot(*y0)
    return np.array([speed * (t - crossing), speed])


def fanned(y0: Any, t: float) -> Any:
    """Against the fan until x = 0, then straight on."""
    speed = np.sqrt(y0[1] ** 2 + 2 * y0[0])
    return np.array([-speed * (t - y0[1] - speed), -speed])


@pytest.mark.parametrize("build, motion", [(order.slack_band, slack), (order.edge_of_a_fan, fanned)])
def test_kink_and_jump_in_closed_form(build: Any, motion: Any) -> None:
    """States and their derivatives, against the motion from any start."""
    problem, end, step = build(), build().duration, 1e-6
    np.testing.assert_allclose(problem.exact(end), motion(problem.y0, end), rtol=1e-14)
    sides = [[motion(problem.y0 + s * e, end) for s in (step, -step)] for e in np.eye(2)]
    slope = np.array([(ahead - behind) / (2 * step) for ahead, behind in sides]).T
    found = np.array([problem.transposed_flow(mu) for mu in np.eye(2)])
    np.testing.assert_allclose(found, slope, atol=1e-8)
    there, h = 0.3 * end, 1e-4
    motion_there = np.array([problem.exact(there + s * h)[0] for s in (-1, 0, 1)])
    force = problem.system.effects[0].force(0.0, motion_there[1:2], np.zeros(1))
    assert (motion_there @ [1, -2, 1]) / h**2 == pytest.approx(force[0], rel=1e-6)


def test_the_gradient_converges_like_the_state_where_the_force_is_smooth() -> None:
    smooth, kink, jump = converged().values()
    assert not red(order.order_checks(smooth, kink, jump))


def test_confused_forces_are_red() -> None:
    smooth, kink, jump = converged().values()
    both = replace(kink, cells=(*kink.cells, *(c for c in smooth.cells if c.method == "ImplicitMidpoint")))
    lost = red(order.order_checks(both, kink, jump))
    assert "RK4: orders of state and gradient on marble-in-a-bowl, difference" not in lost
    assert any(text.startswith("RK4: orders of state and gradient") for text in lost)
    assert len(red(order.order_checks(smooth, smooth, jump))) >= 2
    assert any("stays wrong" in text for text in red(order.order_checks(smooth, kink, smooth)))


def test_a_wrong_gradient_is_red() -> None:
    """One per cent off: the gradient's error stops falling."""
    good, (smooth, kink, jump) = order.marble_in_a_bowl(), converged().values()
    flow: Any = good.transposed_flow
    bad = replace(good, transposed_flow=lambda mu: 1.01 * flow(mu))
    wrong = work_precision(bad, (RK4(),), order.SHORT).cells
    mixed = replace(smooth, cells=(*(c for c in smooth.cells if c.method != "RK4"), *wrong))
    assert red(order.order_checks(mixed, kink, jump)) == [
        "RK4: orders of state and gradient on marble-in-a-bowl, difference"
    ]


# Three ways


@pytest.mark.parametrize("way", ["sensitivity", "block_system", "adjoint"])
def test_each_of_the_three_ways_can_be_red(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = block_system

    def wrong_block(trajectory: Any) -> Any:
        made = whole(trajectory)
        return replace(made, dGdp=made.dGdp * (1 + 1e-9))

    def wrong_adjoint(*arguments: Any) -> Any:
        made = adjoint(*arguments)
        return replace(made, theta=made.theta * (1 + 1e-9))

    changed = {
        "sensitivity": lambda *a: sensitivity(*a) * (1 + 1e-9),
        "block_system": wrong_block,
        "adjoint": wrong_adjoint,
    }
    monkeypatch.setattr(ways, way, changed[way])
    assert len(red(ways.three_ways(BackwardEuler()))) >= 8


def test_a_kind_that_changes_nothing_is_no_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    made = ways.driven_net

    def calm(steps: int = 4, seed: int = 0) -> Any:
        system, y0 = made(steps, seed)
        theta = system.theta.copy()
        theta[system.split(np.arange(system.parameter_count))["drag.coefficient"]] = 0.0
        return system.with_theta(theta), y0

    monkeypatch.setattr(ways, "driven_net", calm)
    assert red(ways.three_ways(RK4())) == ["RK4: three ways to the derivative by drag.wind"]


# Pictures


@pytest.mark.parametrize("stepper", [BackwardEuler(), TwoStepBackwardEuler(), BDF2()], ids=lambda s: type(s).__name__)
def test_without_copies_the_block_system_says_the_same(stepper: Any) -> None:
    system, y0 = ways.driven_net()
    whole = block_system(simulate(stepper, system, y0, ways.H, ways.STEPS))
    small, ny = whole.reduced(), y0.size
    expected = whole.derivative()
    past = len(whole.ticks) - 1 - ways.STEPS
    assert small.dGdx.shape == ((ways.STEPS + past) * ny,) * 2
    np.testing.assert_allclose(small.derivative(), expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    rows, columns = small.dGdx.nonzero()
    assert set((rows // ny - columns // ny).tolist()) == ({0, 1, 2} if past else {0, 1})


@pytest.mark.parametrize("stepper", [BackwardEuler(), TwoStepBackwardEuler()], ids=lambda s: type(s).__name__)
def test_the_spy_plot_shows_every_sign(stepper: Any) -> None:
    system, y0 = ways.driven_net()
    whole = block_system(simulate(stepper, system, y0, ways.H, ways.STEPS)).reduced()
    figure = spy_plot.spy(whole)
    for axes, matrix in zip(figure.axes, (whole.dGdx, whole.dGdp), strict=True):
        pixels = np.asarray(axes.images[0].get_array())
        values = matrix.toarray()
        for sign, colour in ((1, spy_plot.PLUS), (-1, spy_plot.MINUS)):
            assert ((pixels == to_rgb(colour)).all(axis=2) == (np.sign(values) == sign)).all()
    names = [tick.get_text() for tick in figure.axes[1].get_xticklabels()]
    assert names[:3] == ["start $x_0$", "mass", "gravity"] and names[-1] == "force 3"


def test_the_cost_picture_tells_run_from_extrapolated() -> None:
    study = cost.gradient_cost(NET, replace(COUNTED, most=12))
    left, right = pictures.gradient_cost(study).axes
    dotted = [line for line in left.lines if line.get_linestyle() == ":" and len(line.get_xdata())]
    assert len(dotted) == 4 and all(line.get_xdata()[-1] == 30 for line in dotted)
    assert len(right.lines) == 5 and "passes" in left.get_ylabel()


def test_the_order_picture_has_both_lines_of_every_method() -> None:
    studies = converged()
    for axes, (title, study) in zip(pictures.gradient_orders(studies).axes, studies.items(), strict=True):
        lines = [line for line in axes.lines if len(line.get_xdata())]
        assert axes.get_title(loc="left") == title and len(lines) == 2 * len(study.methods)
        for line, quantity in zip(lines, ("state", "gradient"), strict=False):
            cells = study.of(study.methods[0])
            np.testing.assert_array_equal(line.get_ydata(), [max(c.error_of(quantity), 1e-16) for c in cells])


# The command and the section


@pytest.mark.parametrize("passed, code", [(True, 0), (False, 1)])
def test_the_command(passed: bool, code: int, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    results = gradient_cost.Results(counted(), converged())
    monkeypatch.setattr(gradient_cost, "measure", lambda *a: results)
    if not passed:
        monkeypatch.setattr(order, "order_checks", lambda *a: [Check("RK4", "converges", False, 0.0, "1")])
    monkeypatch.setattr(gradient_cost, "draw", lambda results, to: None)
    done = CliRunner().invoke(app, ["accuracy", "gradients", "--quick", "--to", str(tmp_path)])
    assert done.exit_code == code, done.output
    assert ("FAIL" in done.output) is not passed
    assert max(map(len, (tmp_path / "table.txt").read_text(encoding="utf-8").splitlines())) <= 80
    data = json.loads((tmp_path / "accuracy.json").read_text(encoding="utf-8"))
    assert not data["studies"] and set(data["gradients"]) == {"cost", "orders", "checks"}
    assert data["gradients"]["cost"]["growth"]["adjoint"] == pytest.approx(0, abs=1e-12)


def test_both_pictures_are_written(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(gradient_cost, "save", lambda figure, path: written.append(path.name))
    gradient_cost.draw(gradient_cost.Results(counted(), converged()), tmp_path)
    assert sorted(written) == sorted(
        f"gradient-{what}.{kind}" for what in ("cost", "orders") for kind in ("png", "svg")
    )


def test_what_is_measured_for_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(cost, "gradient_cost", lambda net, sweep, store, progress: asked.append((net, sweep)))
    monkeypatch.setattr(gradient_cost, "orders", lambda quick, store, progress: {})
    for quick in (True, False):
        gradient_cost.measure(quick, Store(), print)
    (small, short), (large, whole) = asked
    assert small.points == 24 and short.counts[-1] == 1000
    assert large.points == 52 and whole.counts == (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)


def test_help_has_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = CliRunner().invoke(app, ["accuracy", "--help"]).output
    assert "dsim accuracy gradients" in shown and "10,000" in shown
    with pytest.raises(ValueError, match="did you mean gradients"):
        accuracy.select(["gradient"])


def test_the_section(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every part in its order; the studies themselves are those tested above."""
    studies = counted(), converged()  # made before the name they are made with is exchanged
    monkeypatch.setattr(cost, "gradient_cost", lambda *a: studies[0])
    monkeypatch.setattr(gradient_cost, "orders", lambda *a: studies[1])
    monkeypatch.setattr(gradients, "to_svg", lambda figure: b"<svg></svg>")
    monkeypatch.setattr(gradients.catalog, "STEPPERS", (BackwardEuler(), RK4()))
    monkeypatch.setattr(gradients, "PARTS", gradients.PARTS[:3])
    told: list[str] = []
    section = gradients.gradients(told.append)
    assert not red(section.checks) and len(section.checks) == 2 * 9 + 9
    assert len(section.pictures) == 3 and len(section.tables) == 2 and "RK4" in told
    assert [len(table.rows) for table in section.tables] == [2, 10]
    costs = gradients.gradient_cost(told.append)
    assert not red(costs.checks) and len(costs.checks) == len(cost.cost_checks(counted()))
    assert [len(table.rows) for table in costs.tables] == [3, 3] and len(costs.pictures) == 1
