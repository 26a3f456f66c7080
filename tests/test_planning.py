"""Plans: what is off is never evaluated, predictions are what happens, warnings are true."""

import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from dsim import Flow, System, adjoint, catalog, plan, scenes, simulate
from dsim.cli import app
from dsim.effects import Drag, Field, Gravity, Springs
from dsim.planning import highest_damping, highest_frequency
from dsim.simulation import record
from dsim.solve import Status
from dsim.steppers import RK4, BackwardEuler, ForwardEuler, SymplecticEuler, VelocityVerlet
from dsim.studies.effect_cost import pay_back


def stages(made):
    return {line.stage: line for line in made.lines}


@pytest.mark.parametrize("build", catalog.SCENES, ids=lambda b: b.__name__)
def test_predicted_counts_are_the_actual_ones(build):
    scene = build(steps=5)
    made = plan(scene.system, scene.stepper, scene.y0, scene.h)
    actual = scene.simulate().counters
    for name in ("forces", "jacobians", "factorizations", "newton_iterations"):
        predicted = 5 * getattr(made.predicted, name)
        assert getattr(actual, name) >= predicted if made.implicit else getattr(actual, name) == predicted


@pytest.mark.parametrize("build", catalog.SCENES, ids=lambda b: b.__name__)
def test_every_line_fits_and_every_off_line_has_a_reason(build):
    scene = build()
    made = plan(scene.system, scene.stepper, scene.y0, scene.h)
    assert all(len(line) <= 80 for line in str(made).splitlines())
    assert all(len(line.why) > 10 for line in made.lines if line.state == "off")


def oscillator(w):
    return System([1.0], Field(lambda x: -(w**2) * x, lambda x: np.full((1, 1, 1), -(w**2))), 1)


@pytest.mark.parametrize("stepper", [SymplecticEuler(), VelocityVerlet(), RK4()], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_the_warning_is_the_limit_of_stability(stepper, factor):
    h = 0.1
    system = oscillator(factor * stepper.frequency_limit / h)
    made = plan(system, stepper, [1.0, 0.0], h)
    run = record(stepper, system, [1.0, 0.0], h, 20_000)
    grew = run.status is not Status.CONVERGED or np.abs(run.q).max() > 100
    assert bool(made.warnings) == grew == (factor > 1)


def test_forward_euler_is_warned_of_every_undamped_oscillation():
    warning = plan(oscillator(0.1), ForwardEuler(), [1.0, 0.0], 0.01).warnings
    assert len(warning) == 1 and "SymplecticEuler" in warning[0].why


def test_frequencies_of_a_chain_and_damping():
    """Fixed-fixed chain of n unit masses: w_j = 2 sqrt(k/m) sin(j pi / (2 (n + 1))); sparse and dense."""
    for n in (10, 200):
        springs = Springs([(i, i + 1) for i in range(n + 1)], 0.0, 9.0)
        system = System(np.ones(n + 2), (springs, Drag(0.7)), 1, fixed=(0, n + 1))
        y0 = np.concatenate([np.arange(n + 2.0), np.zeros(n + 2)])
        assert highest_frequency(system, y0) == pytest.approx(6 * np.sin(n * np.pi / (2 * (n + 1))), rel=1e-4)
        assert highest_damping(system, y0) == pytest.approx(0.7, rel=1e-4)


def test_stiff_damping_is_warned_of():
    system = System([1.0], Drag(300.0), 1)
    assert "h d_max = 3" in plan(system, SymplecticEuler(), [0.0, 1.0], 0.01).warnings[0].stage
    assert not plan(system, BackwardEuler(), [0.0, 1.0], 0.01).warnings


def test_the_tape_is_on_only_where_a_gradient_is_wanted():
    arguments = (oscillator(1.0), SymplecticEuler(), [1.0, 0.0], 0.1)
    assert stages(plan(*arguments))["tape"].state == "off"
    assert stages(plan(*arguments, want=("gradient",)))["tape"].state == "on"
    with pytest.raises(ValueError, match="want must name some of gradient; got 'speed'"):
        plan(*arguments, want=("speed",))


def test_what_is_off_is_never_evaluated(monkeypatch):
    """Jacobians of an explicit run are off: patched to raise, they are not missed."""

    def forbidden(*arguments):
        raise AssertionError("this stage is off")

    scene = catalog.SCENES[2]()
    assert stages(plan(scene.system, scene.stepper, scene.y0, scene.h))["Jacobians, factorization"].state == "off"
    for capability in ("dq", "dv", "dtheta", "stage_matrix"):
        monkeypatch.setattr(System, capability, forbidden)
    run = scene.simulate()
    assert run.counters.jacobians == run.counters.factorizations == run.counters.solves == 0
    with pytest.raises(AssertionError, match="this stage is off"):
        scene.simulate(BackwardEuler())


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_an_unused_capability_leaves_every_bit(stepper):
    class Talkative(Gravity):
        def power(self, t, q, v):
            raise AssertionError("nobody asked")

    y0 = np.array([0.0, 1.0, 2.0, 3.0])
    runs = [simulate(stepper, System([2.0], g([0.0, -9.8]), 2), y0, 0.1, 10) for g in (Gravity, Talkative)]
    assert np.array_equal(runs[0].y, runs[1].y)


def test_a_particle_scene_loads_numpy_alone():
    program = (
        "import sys; from dsim import Flow, System, adjoint, simulate; from dsim.effects import Drag, Gravity;"
        "from dsim.steppers import SymplecticEuler; import numpy as np;"
        "run = simulate(SymplecticEuler(), System([1.0], (Gravity([0, -9.8]), Drag(0.1)), 2), [0, 0, 1, 1], 0.1, 5);"
        "adjoint(run, np.ones_like(run.y));"
        "print([m for m in sys.modules if m.startswith(('scipy', 'matplotlib', 'rich', 'typer'))])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_forbidden_effect_is_left_out_with_a_warning_where_it_acts():
    idle = Springs([(0, 1)], 1.0, 0.0, name="idle")
    system = System([1.0, 1.0], [Gravity([0.0, -9.8]), Drag(0.3), idle], 2)
    y0 = np.array([0.0, 0, 1, 0, 0, 0, 0, 0])
    for name, words in (
        ("gravity", "pushes with up to 9.8 N"),
        ("drag", "as soon as a velocity changes"),
        ("idle", ""),
    ):
        made = plan(system, SymplecticEuler(), y0, 0.1, forbid=(name,))
        assert [e.name for e in made.system.effects] == [e.name for e in system.effects if e.name != name]
        assert stages(made)[name].state == "off" and "forbid" in stages(made)[name].why
        assert [line.stage for line in made.warnings] == ([f"no {name}"] if words else [])
        assert words in str(made) and all(len(line) <= 80 for line in str(made).splitlines())
    with pytest.raises(ValueError, match=r"no effect is called 'wind'; this system has gravity, drag, idle"):
        plan(system, SymplecticEuler(), y0, 0.1, forbid=("wind",))
    with pytest.raises(ValueError, match="forbid needs a System"):
        plan(Flow(lambda t, y: -y, 1), SymplecticEuler(), [1.0], 0.1, forbid=("drag",))
    result = CliRunner().invoke(app, ["plan", "projectile", "--forbid", "drag"])
    assert result.exit_code == 1 and "no drag" in result.output and "forbidden" in result.output


def test_pay_back_tells_cost_and_change():
    scene = catalog.SCENES[0]()
    rows = {row.effect: row for row in pay_back(scene, rounds=1)}
    assert set(rows) == {effect.name for effect in scene.system.effects}
    assert rows["gravity"].change > 0.1 and all(row.cost > 0 and row.forces == 0 for row in rows.values())
    with pytest.raises(ValueError, match="river is a flow"):
        pay_back(scenes.river())


def test_pay_back_of_bodies_tells_what_the_gyroscopic_torque_changes():
    rows = {row.effect: row for row in pay_back(scenes.racket(steps=120), rounds=1)}
    assert set(rows) == {"gyroscopic"} and rows["gyroscopic"].change > 0.1
    hung = {row.effect: row.change for row in pay_back(scenes.sign(steps=10), rounds=1)}
    assert set(hung) == {"drag", "angular_drag", "gravity", "springs", "spring_damping", "wind", "gyroscopic"}
    assert hung["springs"] > hung["wind"] > 0


def test_the_command():
    result = CliRunner().invoke(app, ["plan", "projectile", "--pay-back"])
    assert result.exit_code == 0 and "plan: 1 point, RK4" in result.stdout and "== 4" in result.stdout
    assert all(len(line) <= 80 for line in result.stdout.splitlines())
    warned = CliRunner().invoke(app, ["plan", "pendulum_stiff", "--stepper", "SymplecticEuler"])
    assert warned.exit_code == 1 and "h w_max" in warned.stdout
    assert "did you mean" in str(CliRunner().invoke(app, ["plan", "clot"]).exception)


def test_the_gradient_of_a_planned_run_is_there():
    run = simulate(SymplecticEuler(), oscillator(1.0), [1.0, 0.0], 0.1, 5)
    assert np.isfinite(adjoint(run, np.ones_like(run.y)).y0).all()


def test_plans_of_nothing_of_zero_springs_and_of_descent():
    free = System([1.0], (), 1)
    run = record(BackwardEuler(), free, [0.0, 1.0], 0.1, 3)
    made = plan(free, BackwardEuler(), [0.0, 1.0], 0.1)
    assert run.counters.forces >= 3 * made.predicted.forces and run.counters.jacobians >= 3 * made.predicted.jacobians
    for effect in (Springs([(0, 1)], 1.0, 0.0), Drag(0.0)):
        idle = System(np.ones(150), effect, 1)
        assert plan(idle, SymplecticEuler(), np.ones(300), 0.1).warnings == ()
    pairs = np.stack([np.arange(149), np.arange(1, 150)], axis=1)
    chain = System(np.ones(150), Springs(pairs, 0.5, 10.0), 1)
    y0 = np.r_[np.arange(150.0), np.zeros(150)]
    made = plan(chain, BackwardEuler(), y0, 0.1, want=("gradient",))
    kept = simulate(BackwardEuler(), chain, y0, 0.1, 1, keep="factors").steps[0].factor_bytes
    assert "band Cholesky" in str(made) and f"{kept / 1e6:.3g} MB a step" in str(made)
    descent = plan(chain, BackwardEuler(globalize="energy"), y0, 0.1, want=("gradient",))
    assert "band" not in str(descent) and "factors" not in stages(descent)["tape"].why


def test_frequencies_see_masses_and_damping_its_limit():
    system = System(np.full(2, 4.0), Springs([(0, 1)], 1.0, 8.0), 1)
    assert highest_frequency(system, np.array([0.0, 1.0, 0.0, 0.0])) == pytest.approx(2.0)
    for c, warned in ((1.99, False), (2.01, True)):
        damped = System([1.0], Drag(c), 1)
        assert bool(plan(damped, SymplecticEuler(), [0.0, 1.0], 1.0).warnings) == warned
