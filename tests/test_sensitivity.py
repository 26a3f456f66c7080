"""Derivatives of whole trajectories: the block system, forward sensitivities and the adjoint must agree."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from dsim import catalog
from dsim.arrays.checks import Array
from dsim.effects import Actuation, Gravity, Springs
from dsim.gradients import adjoint, block_system, sensitivities, sensitivity
from dsim.simulation import record, simulate
from dsim.steppers import BackwardEuler, ForwardEuler, RuleStepper, SymplecticEuler
from dsim.studies.gradient_check import check_gradient
from dsim.studies.three_ways import STEPS, H, three_ways
from dsim.studies.three_ways import driven_net as everything
from dsim.system import Flow, System

KINDS = ("mass", "gravity.acceleration", "drag.coefficient", "drag.wind", "springs.rest_length", "springs.stiffness",
         "spring_damping.coefficient", "actuation.forces")  # fmt: skip


def run(stepper: Any, keep: Any = "states") -> Any:
    system, y0 = everything()
    return simulate(stepper, system, y0, H, STEPS, keep)


@pytest.mark.parametrize("stepper", catalog.STEPPERS, ids=lambda s: type(s).__name__)
def test_three_ways_agree(stepper: RuleStepper) -> None:
    checks = three_ways(stepper)
    assert [check.statement.split()[-1] for check in checks] == ["start", *KINDS]
    assert all(check.passed for check in checks)
    trajectory = run(stepper)
    ny, count = trajectory.y.shape[1], trajectory.system.parameter_count
    dy0, dtheta = np.split(np.eye(ny + count), [ny])
    assert sensitivity(trajectory, dy0, dtheta).shape == (STEPS + 1, ny, ny + count)


def test_every_kind_of_parameter_matters_there() -> None:
    trajectory = run(BackwardEuler())
    weights = np.random.default_rng(1).normal(size=trajectory.y.shape)
    gradient = adjoint(trajectory, weights)
    assert tuple(gradient.parts) == KINDS
    assert all(np.abs(gradient[name]).max() > 1e-6 for name in KINDS)


def test_explicit_dependence_on_parameters() -> None:
    """O = w . y + (sum of k^2) / 2: the parameters act through the path and by themselves."""
    system, y0 = everything()
    weights = np.random.default_rng(3).normal(size=(STEPS + 1, system.size))

    def objective(stiffness: Array) -> tuple[float, Array]:
        there = system.with_theta(system.join(**{"springs.stiffness": stiffness}))
        trajectory = simulate(SymplecticEuler(), there, y0, H, STEPS)
        gradient = adjoint(trajectory, weights, {"springs.stiffness": stiffness})
        value = (weights * trajectory.y).sum() + 0.5 * (stiffness**2).sum()
        return float(value), gradient["springs.stiffness"]

    report = check_gradient(objective, system.split(system.theta)["springs.stiffness"])
    assert report.ok, str(report)


def test_linear_system_in_closed_form() -> None:
    """Forward Euler on a free point: x_N = x0 + N h v0 + h^2 g N (N-1) / 2, so every derivative is known."""
    system = System([2.0], Gravity([-9.81]), dimension=1)
    trajectory = simulate(ForwardEuler(), system, [0.0, 1.0], 0.1, 7)
    dy0, dtheta = np.split(np.eye(4), [2])
    last = sensitivity(trajectory, dy0, dtheta)[-1]
    np.testing.assert_allclose(last, [[1, 0.7, 0, 0.01 * 21], [0, 1, 0, 0.7]], atol=1e-14)


def test_one_direction_is_a_column() -> None:
    trajectory = run(BackwardEuler())
    rng = np.random.default_rng(4)
    system: Any = trajectory.system
    dy0, dtheta = rng.normal(size=(system.size, 3)), rng.normal(size=(system.parameter_count, 3))
    columns = sensitivity(trajectory, dy0, dtheta)
    np.testing.assert_allclose(columns[..., 1], sensitivity(trajectory, dy0[:, 1], dtheta[:, 1]), rtol=1e-12)
    only_start = sensitivity(trajectory, dy0) + sensitivity(trajectory, None, dtheta)
    np.testing.assert_allclose(columns, only_start, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(list(sensitivities(trajectory, dy0, dtheta))[-1], columns[-1])


def test_flow() -> None:
    """dy/dt = A y: forward Euler's Jacobian is (1 + h A)^N."""
    A = np.array([[0.0, 1.0], [-2.0, -0.3]])
    trajectory = simulate(ForwardEuler(), Flow(lambda t, y: A @ y, 2, lambda t, y: A), [1.0, 0.0], 0.1, 5)
    power = np.linalg.matrix_power(np.eye(2) + 0.1 * A, 5)
    np.testing.assert_allclose(sensitivity(trajectory, np.eye(2))[-1], power, rtol=1e-13)
    np.testing.assert_allclose(block_system(trajectory).derivative()[-1], power, rtol=1e-13)


def test_block_system_is_block_lower_triangular() -> None:
    """dG/dx has a block on the diagonal and one below; actuation fills a block diagonal of dG/dp."""
    trajectory = run(BackwardEuler())
    system: Any = trajectory.system
    whole = block_system(trajectory)
    ny = system.size
    rows, columns = whole.dGdx.nonzero()
    assert set((rows // ny - columns // ny).tolist()) == {0, 1}
    actuation = system.split(np.arange(system.parameter_count))["actuation.forces"]
    by_forces = whole.dGdp[:, ny + actuation.ravel()].toarray()
    rows, columns = np.nonzero(by_forces)
    assert (rows // ny == columns // 8).all() and set(rows // ny) == set(range(STEPS))
    assert not whole.dGdp[ny:, :ny].nnz  # the start enters the first step alone


def test_a_flipped_block_is_seen() -> None:
    """Mutation: with the sign of the blocks below the diagonal flipped, the three ways disagree."""
    from scipy.sparse import csr_array, tril

    trajectory = run(BackwardEuler())
    whole = block_system(trajectory)
    ny = whole.dGdp.shape[0] // STEPS
    below = csr_array(tril(whole.dGdx, -ny))
    wrong = type(whole)(trajectory, csr_array(whole.dGdx - 2 * below), whole.dGdp, whole.ticks)
    right = sensitivity(trajectory, np.eye(ny))[-1]
    assert np.abs(wrong.derivative()[-1][:, :ny] - right).max() > 0.1


@pytest.mark.parametrize("stepper", [SymplecticEuler(), BackwardEuler()], ids=lambda s: type(s).__name__)
def test_adjoint_touches_only_the_entries_of_its_step(stepper: Any) -> None:
    """Parameters grow with the steps: no step of the adjoint may do work in proportion to all of them."""
    steps, points = 8, 20_000
    forces = np.zeros((steps, points, 1))
    system = System(np.ones(points), Actuation(forces, H), dimension=1)
    trajectory = simulate(stepper, system, np.zeros(2 * points), H, 1)
    weights = np.ones(2 * points)
    adjoint(trajectory, weights)
    peaks = []
    for rows in (steps, 4 * steps):
        system = System(np.ones(points), Actuation(np.zeros((rows, points, 1)), H), dimension=1)
        trajectory = simulate(stepper, system, np.zeros(2 * points), H, 1)
        system.theta  # noqa: B018  (made once, before the measurement)
        tracemalloc.start()
        adjoint(trajectory, weights)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] <= 1.05 * 8 * 3 * steps * points  # theta_bar itself, and nothing else of its size


BAD_CHANGES = {
    "dy0 too short": ({"dy0": np.zeros(3)}, "dy0 must have shape"),
    "dtheta too short": ({"dtheta": np.zeros(2)}, "dtheta must have shape"),
    "columns differ": ({"dy0": np.zeros((16, 2)), "dtheta": np.zeros((52, 3))}, "as many columns"),
    "NaN": ({"dy0": np.full(16, np.nan)}, "dy0 must be finite"),
}


@pytest.mark.parametrize("case", BAD_CHANGES)
def test_bad_changes(case: str) -> None:
    changes, message = BAD_CHANGES[case]
    trajectory = run(SymplecticEuler())
    with pytest.raises(ValueError, match=message):
        sensitivity(trajectory, **changes)


def failed() -> Any:
    """A run that overflows midway."""
    system = System([1.0, 1.0], Springs([(0, 1)], 1.0, 1e8), dimension=1, fixed=[0])
    return record(ForwardEuler(), system, [0.0, 1.5, 0.0, 0.0], 0.01, 400)


def test_a_run_that_failed_midway_is_named() -> None:
    trajectory = failed()
    assert len(trajectory.t) < 401
    for derivative in (lambda t: adjoint(t, np.ones(4)), lambda t: sensitivity(t, np.ones(4)), block_system):
        with pytest.raises(ValueError, match=r"reached its end; ForwardEuler failed in step \d+ .*completed"):
            derivative(trajectory)
    with np.errstate(over="ignore", invalid="ignore"):
        assert sensitivity(trajectory.completed, np.zeros(4)).shape == (len(trajectory.t), 4)


def test_bad_explicit_part() -> None:
    trajectory = run(SymplecticEuler())
    with pytest.raises(ValueError, match="dJdtheta must name parameters"):
        adjoint(trajectory, np.zeros(16), {"spring.stiffness": np.zeros(4)})
    with pytest.raises(ValueError, match=r"dJdtheta\['springs.stiffness'\] must have shape"):
        adjoint(trajectory, np.zeros(16), {"springs.stiffness": np.zeros(5)})
    with pytest.raises(ValueError, match="dJdtheta must have shape"):
        adjoint(trajectory, np.zeros(16), np.zeros(5))


def test_block_system_needs_a_step() -> None:
    system, y0 = everything()
    with pytest.raises(ValueError, match="at least one step"):
        block_system(simulate(BackwardEuler(), system, y0, H, 0))


def test_block_system_refuses_what_is_no_number() -> None:
    system, y0 = everything()
    whole = block_system(simulate(BackwardEuler(), system, y0, H, 2))
    with pytest.raises(ValueError, match="dJdy must be finite"):
        whole.gradient(np.full((3, len(y0)), np.nan))
    with pytest.raises(ValueError, match="dJdy must have shape"):
        whole.gradient(np.zeros((2, len(y0))))
    with pytest.raises(ValueError, match="dp must be finite"):
        whole.derivative(np.full(whole.dGdp.shape[1], np.nan))
