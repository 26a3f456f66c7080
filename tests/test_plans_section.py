"""The plan's and the speed's sections: counts that are checked, exponents that are known, pictures that are drawn."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from dsim import catalog, plan, scenes
from dsim.cli import app
from dsim.pictures import plan as pictures
from dsim.planning import Plan
from dsim.report import plans
from dsim.simulation import record
from dsim.steppers.stepper import Counters
from dsim.studies import growth
from dsim.studies.effect_cost import PayBack


def counted(scene):
    return record(scene.stepper, scene.system, scene.y0, scene.h, plans.STEPS).counters


@pytest.mark.parametrize("build", catalog.SCENES, ids=lambda b: b.__name__)
def test_the_plan_of_every_scene_holds(build):
    scene = build()
    made = plan(scene.system, scene.stepper, scene.y0, scene.h)
    assert all(check.passed for check in plans.plan_checks(scene, made, counted(scene)))


def test_a_plan_that_lies_is_red(monkeypatch):
    scene = scenes.projectile()
    made = plan(scene.system, scene.stepper, scene.y0, scene.h)
    counters = counted(scene)
    wrong = {
        "force calls": replace(counters, forces=counters.forces + 1),
        "Jacobians and factorizations while off": replace(counters, jacobians=1),
    }
    for statement, changed in wrong.items():
        red = [check.statement for check in plans.plan_checks(scene, made, changed) if not check.passed]
        assert red == [statement]
    net = scenes.cloth(n=4)
    made = plan(net.system, net.stepper, net.y0, net.h)
    too_many = Counters(forces=100, factorizations=9, newton_iterations=8)
    assert [c.statement for c in plans.plan_checks(net, made, too_many) if not c.passed] == ["factorizations"]
    too_few = Counters(forces=5, factorizations=3, newton_iterations=3)  # three steps need two each
    assert [c.statement for c in plans.plan_checks(net, made, too_few) if not c.passed] == ["force calls"]
    hung = scenes.pendulum_spring()
    made = plan(hung.system, hung.stepper, hung.y0, hung.h)
    monkeypatch.setattr(Plan, "warnings", ())
    red = [c.statement for c in plans.plan_checks(hung, made, counted(hung)) if not c.passed]
    assert red == ["warnings at 1000 h"]


def test_exponents_of_known_powers():
    x = [1.0, 2.0, 4.0, 8.0]
    row = growth.Growth("explicit run", "steps", tuple(x), tuple(3 * v**1.5 for v in x), tuple(v**2 for v in x))
    assert row.time_exponent == pytest.approx(1.5) and row.memory_exponent == pytest.approx(2.0)


def test_memory_that_grows_too_fast_is_red():
    row = growth.Growth("explicit run", "steps", (1.0, 2.0), (1.0, 2.0), (1.0, 4.0))
    assert [check.passed for check in plans.growth_checks([row, replace(row, bytes=(1.0, 2.0))])] == [False, True]


def test_memory_of_explicit_runs_is_linear_and_seconds_are_positive():
    for kind in ("explicit run", "explicit run and gradient"):
        row = growth.measure(kind, "unknowns", [(8, 20), (16, 20), (32, 20)], repeats=1)
        assert row.amounts == (192.0, 768.0, 3072.0) and min(row.seconds) > 0
        assert 0.8 < row.memory_exponent < 1.1


@pytest.mark.parametrize(("kind", "varied", "named"), [("explicit", "steps", "kind"), ("implicit run", "h", "varied")])
def test_unknown_words_are_named(kind, varied, named):
    with pytest.raises(ValueError, match=f"{named} must be"):
        growth.measure(kind, varied, [(4, 2)])


def test_pictures_show_every_scene_effect_and_kind():
    made = {
        name: plan(s.system, s.stepper, s.y0, s.h) for name, s in ((s.name, s) for s in (b() for b in catalog.SCENES))
    }
    axes = pictures.overview(made).axes[0]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == list(made)
    discs = sum(line.get_markerfacecolor() != "white" for line in axes.lines)
    assert discs == sum(line.state == "on" for plan_ in made.values() for line in plan_.lines)
    rows = (PayBack("springs", 1.4, np.inf, 3), PayBack("drag", 1.1, 0.0, 0))
    words = [text.get_text() for text in pictures.pay_back("net", rows).axes[0].texts]
    assert words == ["springs (without: fails)", "drag"]
    line = growth.Growth("explicit run", "steps", (1.0, 2.0), (1.0, 2.0), (1.0, 2.0))
    found = pictures.growth([line, replace(line, varied="unknowns")])
    assert [len(panel.lines) for panel in found.axes] == [1, 1]


def test_the_command_draws_the_pay_back(tmp_path):
    target = tmp_path / "pay.png"
    result = CliRunner().invoke(app, ["plan", "projectile", "--to", str(target)])
    assert result.exit_code == 0 and "drag" in result.output and target.read_bytes().startswith(b"\x89PNG")
    refused = CliRunner().invoke(app, ["plan", "projectile", "--to", "pay.txt"])
    assert isinstance(refused.exception, ValueError) and "--to must end in" in str(refused.exception)
