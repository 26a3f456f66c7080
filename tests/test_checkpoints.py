"""Binomial checkpointing: the schedule is the best there is, and the gradient has the bits of a full tape."""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from math import comb
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from dsim import catalog, plan, scenes
from dsim.arrays.checks import Array
from dsim.cli import app
from dsim.effects import Gravity, Springs
from dsim.gradients import adjoint
from dsim.pictures.checkpoints import schedule, staircase
from dsim.pictures.style import to_png
from dsim.simulation import SimulationError, record, simulate
from dsim.steppers import BDF2, BackwardEuler, ForwardEuler, RuleStepper, SymplecticEuler
from dsim.steppers import replay as replaying
from dsim.steppers.checkpoints import Action, Checkpoints
from dsim.system import System
from tests.test_sensitivity import H, everything


@lru_cache(None)
def fewest(steps: int, snapshots: int) -> int:
    """The least number of advances before every step has been pulled back, by trying every first snapshot."""
    if steps <= 1:
        return 0
    if snapshots == 1:
        return steps * (steps - 1) // 2
    return min(m + fewest(steps - m, snapshots - 1) + fewest(m, snapshots) for m in range(1, steps))


def executed(steps: int, snapshots: int) -> tuple[Counter[int], int]:
    """Follow a schedule; how often every step was taken, and the most states held."""
    held: set[int] = set()
    current, most = 0, 0
    taken: Counter[int] = Counter()
    pulled = []
    for kind, n, until in Checkpoints(snapshots).schedule(steps):
        if kind == "restore":
            assert n in held
            current = n
            continue
        if kind == "forget":
            held.remove(n)
            continue
        assert n == current
        if kind == "snapshot":
            held.add(n)
            most = max(most, len(held))
        elif kind == "advance":
            taken.update(range(n, until))
            current = until
        elif kind == "finish":
            taken[n] += 1
            assert n == steps - 1 and not pulled
        else:
            pulled.append(n)
    assert pulled == list(range(steps - 1, -1, -1))
    return taken, most


@pytest.mark.parametrize("snapshots", range(1, 9))
def test_schedule_is_optimal(snapshots: int) -> None:
    for steps in range(1, 41):
        taken, most = executed(steps, snapshots)
        binomial = Checkpoints(snapshots)
        assert taken.total() == binomial.advances(steps) == fewest(steps, snapshots) + 1
        assert max(taken.values()) == binomial.most(steps) and most == binomial.stored(steps)


@given(st.integers(1, 1200), st.integers(1, 60))
def test_no_step_is_taken_more_often_than_foretold(steps: int, snapshots: int) -> None:
    if snapshots == 1:
        steps = min(steps, 60)
    taken, most = executed(steps, snapshots)
    binomial = Checkpoints(snapshots)
    assert taken.total() == binomial.advances(steps) and set(taken) == set(range(steps))
    assert max(taken.values()) <= binomial.most(steps) and most == binomial.stored(steps)


def test_the_figures_of_the_literature() -> None:
    """1001 steps are C(10 + 4, 10): with ten states, no step is taken more than four times, and 4 * 1001 - C(14, 3)
    advances suffice, to which comes the last step of the run."""
    assert comb(14, 10) == 1001
    assert Checkpoints(10).most(1001) == 4 and Checkpoints(10).most(1002) == 5
    assert Checkpoints(10).advances(1001) == 4 * 1001 - comb(14, 3) + 1 == 3641
    taken, most = executed(1001, 10)
    assert (taken.total(), max(taken.values()), most) == (3641, 4, 10)


def test_many_snapshots_do_not_nest_too_deep() -> None:
    taken, most = executed(5000, 4000)
    assert most == 4000 and max(taken.values()) == 2


def same(a: Any, b: Any) -> bool:
    return bool((a.y0 == b.y0).all() and (a.theta == b.theta).all())


@pytest.mark.parametrize("stepper", catalog.STEPPERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("snapshots", [1, 2])
def test_gradient_has_the_bits_of_the_full_tape(stepper: RuleStepper, snapshots: int) -> None:
    """With pins, history, and parameters that grow with the steps."""
    steps = 5
    system, y0 = everything(steps)
    full = simulate(stepper, system, y0, H, steps)
    few = simulate(stepper, system, y0, H, steps, keep=Checkpoints(snapshots))
    weights = np.random.default_rng(0).normal(size=(steps + 1, system.size))
    whole = adjoint(full, weights)
    assert (few.last == full.last).all() and (few.first == full.first).all() and (few.t == full.t).all()
    for dJdy in (weights, lambda n, y: weights[n]):
        gradient = adjoint(few, dJdy)
        assert same(gradient, whole) and same(adjoint(full, dJdy), whole)
    assert same(adjoint(few, weights[-1]), adjoint(full, weights[-1]))
    assert steps + gradient.recomputed == Checkpoints(snapshots).advances(steps)


@pytest.mark.parametrize("stepper", [s for s in catalog.STEPPERS if not s.implicit], ids=lambda s: type(s).__name__)
def test_on_coordinate_rows(stepper: RuleStepper) -> None:
    """Runs in place, with and without a tape; forces are evaluated as often as the schedule says."""
    cloth, steps = scenes.cloth(n=3), 40
    h, binomial = cloth.h / 10, Checkpoints(4)
    full = simulate(stepper, cloth.system, cloth.y0, h, steps)
    few = simulate(stepper, cloth.system, cloth.y0, h, steps, keep=binomial)
    assert full.run is not None and few.snapshots is not None
    run = few.snapshots.replay.run  # type: ignore[attr-defined]
    assert run.evaluations == few.counters.forces == full.counters.forces
    by_square = lambda n, y: y  # noqa: E731
    gradient = adjoint(few, by_square)
    assert same(gradient, adjoint(full, full.y))
    taped = adjoint(simulate(stepper, cloth.system, cloth.y0, h, steps, keep="steps"), by_square)
    near = {"rtol": 1e-11, "atol": 1e-13 * np.abs(taped.theta).max()}  # RK4 saves its stages in other arithmetic
    np.testing.assert_allclose(gradient.theta, taped.theta, **near)
    assert (
        run.evaluations == (binomial.advances(steps) + steps) * run.stages
    )  # and one evaluation a step for its pullback
    assert same(adjoint(few, by_square), gradient), "asking again must not change the answer"


def test_a_thousand_and_one_steps() -> None:
    """The bits of a full tape from ten states, four steps taken for each at the most."""
    spring = System([1.0, 1.0], [Springs([(0, 1)], 1.0, 30.0), Gravity([0.0, -1.0])], dimension=2, fixed=[0])
    y0 = [0, 0, 1, 0, 0, 0, 0, 0.5]
    full = simulate(SymplecticEuler(), spring, y0, 0.01, 1001)
    few = simulate(SymplecticEuler(), spring, y0, 0.01, 1001, keep=Checkpoints(10))
    gradient = adjoint(few, full.y)
    assert same(gradient, adjoint(full, full.y))
    assert 1001 + gradient.recomputed == 3641
    assert few.tape_bytes == (10 + 2) * 8 * 8 and full.tape_bytes == 1002 * 8 * 8


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler(), BDF2()], ids=lambda s: type(s).__name__)
def test_the_plan_is_met(stepper: Any) -> None:
    """Memory and recomputation, foretold before the run."""
    steps, few = 30, Checkpoints(4)
    cloth = scenes.cloth(n=2)
    foretold = plan(cloth.system, stepper, cloth.y0, 0.01, want=("gradient",)).recomputation(steps, few)
    trajectory = simulate(stepper, cloth.system, cloth.y0, 0.01, steps, keep=few)
    again = adjoint(trajectory, np.ones(cloth.system.size)).recomputed
    assert (trajectory.tape_bytes, steps + again) == (foretold.bytes, foretold.advances)
    assert foretold.most == 3 and str(foretold).endswith("none more than 3 times")


def test_the_plan_is_printed_with_what_was_taken() -> None:
    result = CliRunner().invoke(app, ["plan", "projectile", "--snapshots", "3"])
    assert result.exit_code == 0
    assert "3 snapshots and 2 states at hand, 32 bytes each" in result.stdout
    assert " predicted: 160 bytes of states, " in result.stdout and " actual:    160 bytes, 90 + " in result.stdout
    advances = Checkpoints(3).advances(90)
    assert f"{advances} steps taken, none more than" in result.stdout and f"= {advances} steps" in result.stdout
    assert isinstance(CliRunner().invoke(app, ["plan", "projectile", "--snapshots", "0"]).exception, ValueError)


def test_path_objective_is_summed_on_the_way_back() -> None:
    """The callable sees every state once, from the last to the first."""
    ball, steps, seen = scenes.projectile(), 23, []

    def square(n: int, y: Array) -> Array:
        seen.append((n, 0.5 * y @ y))
        return y

    few = simulate(ball.stepper, ball.system, ball.y0, ball.h, steps, keep=Checkpoints(3))
    adjoint(few, square)
    y = simulate(ball.stepper, ball.system, ball.y0, ball.h, steps).y
    assert [n for n, _ in seen] == list(range(steps, -1, -1))
    assert sum(value for _, value in seen) == pytest.approx(0.5 * (y**2).sum(), rel=1e-14)


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_stale_velocities_are_seen(stepper: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mutation: a snapshot whose velocities are those of the start gives another gradient."""
    cloth, steps = scenes.cloth(n=2), 20
    h = 0.005
    whole = adjoint(simulate(stepper, cloth.system, cloth.y0, h, steps), np.ones(cloth.system.size))
    few = simulate(stepper, cloth.system, cloth.y0, h, steps, keep=Checkpoints(3))
    assert same(adjoint(few, np.ones(cloth.system.size)), whole)
    assert few.snapshots is not None
    for n, state in few.snapshots.held.items():
        stale = np.array(state)
        stale.reshape(2, -1)[1] = np.asarray(few.snapshots.held[0]).reshape(2, -1)[1]
        few.snapshots.held[n] = stale
    assert not np.allclose(adjoint(few, np.ones(cloth.system.size)).theta, whole.theta, rtol=1e-9)


def test_a_wrong_snapshot_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mutation: a schedule that goes back to the start instead of a later snapshot."""
    ball, real = scenes.projectile(), Checkpoints.schedule

    def wrong(self: Any, steps: int) -> Any:
        for action in real(self, steps):
            yield Action("restore", 0) if action.kind == "restore" else action

    whole = adjoint(simulate(ball.stepper, ball.system, ball.y0, ball.h, 20), np.ones(4))
    few = simulate(ball.stepper, ball.system, ball.y0, ball.h, 20, keep=Checkpoints(3))
    monkeypatch.setattr(replaying.Checkpoints, "schedule", wrong)
    assert not np.allclose(adjoint(few, np.ones(4)).theta, whole.theta, rtol=1e-9)


@pytest.mark.parametrize("snapshots", [0, -1, 1.5, None, "10"])
def test_bad_number_of_snapshots(snapshots: Any) -> None:
    with pytest.raises(ValueError, match="snapshots must be"):
        Checkpoints(snapshots)


def test_states_that_were_not_kept_are_not_made_up() -> None:
    ball = scenes.projectile()
    few = simulate(ball.stepper, ball.system, ball.y0, ball.h, 9, keep=Checkpoints(2))
    for look in (lambda: few.y, lambda: few.q, lambda: few.step(2)):
        with pytest.raises(ValueError, match=r"keeps Checkpoints\(snapshots=2\), not all its states: use .last"):
            look()
    with pytest.raises(ValueError, match='"factors" or Checkpoints'):
        simulate(ball.stepper, ball.system, ball.y0, ball.h, 9, keep=10)  # type: ignore[arg-type]


BAD_LOADS: dict[str, tuple[Any, str]] = {
    "shape": (lambda n, y: y[1:], r"dJdy at n = 9 must have shape \(4,\)"),
    "NaN": (lambda n, y: y * np.nan, "dJdy at n = 9 must be finite"),
    "nothing": (lambda n, y: None, "dJdy at n = 9 must be numbers"),
}


@pytest.mark.parametrize("case", BAD_LOADS)
@pytest.mark.parametrize("keep", ["states", Checkpoints(2)])
def test_bad_callables(case: str, keep: Any) -> None:
    load, message = BAD_LOADS[case]
    ball = scenes.projectile()
    trajectory = simulate(ball.stepper, ball.system, ball.y0, ball.h, 9, keep=keep)
    with pytest.raises(ValueError, match=message):
        adjoint(trajectory, load)


@pytest.mark.parametrize("stepper", [ForwardEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_no_steps(stepper: Any) -> None:
    system, y0 = everything(1)
    few = simulate(stepper, system, y0, H, 0, keep=Checkpoints(2))
    assert (few.last == y0).all()
    gradient = adjoint(few, np.ones(system.size))
    assert (gradient.y0 == 1).all() and not gradient.theta.any()


def test_a_run_that_fails_midway() -> None:
    system = System([1.0, 1.0], Springs([(0, 1)], 1.0, 1e6), dimension=1, fixed=[0])
    arguments: Any = (ForwardEuler(), system, [0.0, 1.5, 0.0, 0.0], 0.01, 400)
    full, few = record(*arguments), record(*arguments, keep=Checkpoints(5))
    assert few.status == full.status and len(few.t) == len(full.t) < 401 and (few.last == full.last).all()
    with pytest.raises(SimulationError, match="ForwardEuler failed in step"):
        simulate(*arguments, keep=Checkpoints(5))
    with pytest.raises(ValueError, match="reached its end"):
        adjoint(few, np.ones(4))
    tiny = np.full(4, 1e-250)
    with np.errstate(over="ignore", invalid="ignore"):
        gradient = adjoint(few.completed, tiny)
        assert same(gradient, adjoint(full.completed, tiny))
    assert gradient.recomputed == Checkpoints(5).advances(len(few.t) - 1)  # it was planned for another length


def test_the_staircase_draws_every_step_as_often_as_it_is_taken() -> None:
    """Every step is pulled back once, in falling order; steps taken and states kept are those of the schedule."""
    steps, snapshots = 60, 4
    checkpoints = Checkpoints(snapshots)
    drawn = staircase(checkpoints, steps)
    assert [line[1][0] for line in drawn.pulls] == list(range(steps - 1, -1, -1))
    assert sum(end[0] - start[0] for start, end in drawn.advances) == checkpoints.advances(steps)
    assert drawn.work == checkpoints.advances(steps) + steps
    alive = [sum(start[1] <= work < end[1] for start, end in drawn.kept) for work in range(drawn.work)]
    assert max(alive) == checkpoints.stored(steps) == snapshots
    assert to_png(schedule(20, 3, 50), dpi=40).startswith(b"\x89PNG")
