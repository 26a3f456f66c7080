"""Value-and-gradient callables for SciPy's optimisers, and the record of an optimisation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.optimize
from scipy.sparse import eye_array

from dsim import Checkpoints, ReducedObjective, Residuals, Variables, scenes, simulate
from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, Springs
from dsim.gradients import optimise
from dsim.steppers import BackwardEuler, SymplecticEuler
from dsim.studies.gradient_check import check_gradient, check_jacobian
from dsim.system import System

H, STEPS = 0.05, 6


def net(seed: int = 0) -> tuple[System, Array]:
    rng = np.random.default_rng(seed)
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    springs = Springs(pairs, rng.uniform(0.6, 1.2, 5), rng.uniform(5, 15, 5))
    system = System(rng.uniform(0.5, 2, 4), [Gravity([0.0, -9.81]), Drag(0.2), springs], 2, fixed=[0])
    return system, np.concatenate([rng.normal(size=8), np.zeros(8)])


def run(system: Any, y0: Array) -> Any:
    return simulate(BackwardEuler(), system, y0, H, STEPS)


def path_objective(trajectory: Any) -> Any:
    """Half the squared positions along the path, and the explicit price of stiff springs."""
    y = trajectory.y.copy()
    y[:, trajectory.system.n :] = 0
    stiffness = trajectory.system.split(trajectory.system.theta)["springs.stiffness"]
    return 0.5 * (y**2).sum() + 0.1 * (stiffness**2).sum(), y, {"springs.stiffness": 0.2 * stiffness}


def observed(trajectory: Any) -> Any:
    """All states and, explicitly, the masses."""
    size, ode = trajectory.y.size, trajectory.system
    r = np.concatenate([trajectory.y.ravel(), 3 * ode.mass])
    by_states = eye_array(size + 4, size, format="csr")
    by_theta = np.zeros((size + 4, ode.parameter_count))
    by_theta[size:, :4] = 3 * np.eye(4)
    return r, by_states, by_theta


ALL = ("positions", "velocities", "mass", "gravity.acceleration", "drag.coefficient", "springs.rest_length",
       "springs.stiffness")  # fmt: skip


def quick(system: Any, y0: Array) -> Any:
    return simulate(SymplecticEuler(), system, y0, H, 2)


ONE_EACH = {"positions": [2, 5], "velocities": [3], "mass": [1], "gravity.acceleration": [1], "drag.coefficient": [0],
            "springs.rest_length": [2], "springs.stiffness": [1, 3]}  # fmt: skip


def test_gradient_by_every_kind_of_variable() -> None:
    system, y0 = net()
    assert len(Variables(system, y0, ALL)) == system.size + system.parameter_count
    variables = Variables(system, y0, ONE_EACH)
    fit = ReducedObjective(quick, variables, path_objective)
    report = check_gradient(fit, variables.start)
    assert report.ok, str(report)
    whole = Variables(system, y0, ALL)
    chosen = [int(np.flatnonzero(whole.entries == entry)[0]) for entry in variables.entries]
    everything = ReducedObjective(quick, whole, path_objective)(whole.start)[1]
    np.testing.assert_array_equal(everything[chosen], fit(variables.start)[1])


def test_jacobian_of_residuals_by_every_kind_of_variable() -> None:
    system, y0 = net()
    variables = Variables(system, y0, ONE_EACH)
    residuals = Residuals(quick, variables, observed)
    report = check_jacobian(residuals, variables.start, residuals.jacobian(variables.start))
    assert report.ok, str(report)
    wrong = residuals.jacobian(variables.start) * 1.01
    assert not check_jacobian(residuals, variables.start, wrong).ok


def test_residuals_simulate_once_for_value_and_jacobian() -> None:
    runs = []
    system, y0 = net()
    variables = Variables(system, y0, ["springs.stiffness"])

    def counted(system: Any, y0: Array) -> Any:
        runs.append(1)
        return run(system, y0)

    residuals = Residuals(counted, variables, observed)
    residuals(variables.start)
    residuals.jacobian(variables.start)
    assert len(runs) == 1
    residuals(variables.start + 1)
    assert len(runs) == 2


def test_variables_place_and_gather() -> None:
    system, y0 = net()
    variables = Variables(system, y0, {"velocities": [2, 3], "springs.stiffness": ..., "mass": 1})
    assert variables.start.tolist() == [0, 0, *system.split(system.theta)["springs.stiffness"], system.mass[1]]
    there, start = variables.place(np.arange(8.0))
    assert start[10:12].tolist() == [0, 1] and np.array_equal(start[:10], y0[:10])
    assert there.split(there.theta)["springs.stiffness"].tolist() == [2, 3, 4, 5, 6] and there.mass[1] == 7
    assert {name: len(part) for name, part in variables.split(np.arange(8)).items()} == {
        "velocities": 2, "springs.stiffness": 5, "mass": 1}  # fmt: skip
    dy0, dtheta = variables.spread(np.eye(8))
    gathered = np.concatenate([dy0, dtheta])[variables.entries]
    np.testing.assert_array_equal(gathered, np.eye(8))


BAD_VARIABLES: dict[str, tuple[Any, str]] = {
    "unknown": (["springs.stifness"], "wrt must name some of y0, positions, .*; got 'springs.stifness'"),
    "one word": ("mass", r'wrt must be names such as \["springs.stiffness"\]'),
    "index": ({"mass": [7]}, r"wrt\['mass'\] must be indices from 0 to 3"),
    "fraction": ({"mass": [0.5]}, r"wrt\['mass'\] must be indices"),
    "twice": (["y0", "velocities"], "every number once"),
    "none": ([], "at least one number"),
    "no name": ([["mass"]], r"wrt must name some of y0, positions, .*; got \['mass'\]"),
    "a name twice": (["mass", "mass"], "every number once"),
}


@pytest.mark.parametrize("case", BAD_VARIABLES)
def test_bad_variables(case: str) -> None:
    wrt, message = BAD_VARIABLES[case]
    with pytest.raises(ValueError, match=message):
        Variables(*net(), wrt)


BAD_ANSWERS: dict[str, tuple[Any, str]] = {
    "a number alone": (lambda t: 1.0, r"objective must return \(value, dOdy\)"),
    "NaN": (lambda t: (np.nan, t.y), "objective must return a finite number; got nan"),
    "an array": (lambda t: (t.last, t.y), "objective must return a finite number"),
    "text": (lambda t: ("a", t.y), "objective must return a finite number; got 'a'"),
    "complex": (lambda t: (1j, t.y), "objective must return a finite number"),
    "NaN gradient": (lambda t: (1.0, np.full(16, np.nan)), "dJdy must be finite"),
    "shape": (lambda t: (1.0, t.y[1:]), r"dJdy must have shape \(7, 16\)"),
    "explicit": (lambda t: (1.0, t.y, {"stiffness": 1.0}), "dJdtheta must name"),
}


@pytest.mark.parametrize("case", BAD_ANSWERS)
def test_bad_objectives(case: str) -> None:
    objective, message = BAD_ANSWERS[case]
    variables = Variables(*net(), ["mass"])
    with pytest.raises(ValueError, match=message):
        ReducedObjective(run, variables, objective)(variables.start)


EXPLICIT = net()[0].parameter_count
BAD_RESIDUALS: dict[str, tuple[Any, str]] = {
    "alone": (lambda t: t.last, "residual must return"),
    "NaN": (lambda t: ([np.nan], np.zeros((1, t.y.size))), "residual's r must be finite"),
    "shape": (lambda t: (t.last, np.eye(16)), r"drdy must have shape \(16, 112\)"),
    "explicit": (lambda t: (t.last, np.zeros((16, t.y.size)), np.eye(3)), "drdtheta must have shape"),
    "NaN Jacobian": (lambda t: (t.last, np.full((16, t.y.size), np.nan)), "residual's drdy must be finite"),
    "NaN explicit": (lambda t: (t.last, np.zeros((16, t.y.size)), np.full((16, EXPLICIT), np.nan)), "be finite"),
}


@pytest.mark.parametrize("case", BAD_RESIDUALS)
def test_bad_residuals(case: str) -> None:
    residual, message = BAD_RESIDUALS[case]
    variables = Variables(*net(), ["mass"])
    with pytest.raises(ValueError, match=message):
        Residuals(run, variables, residual)(variables.start)


@pytest.mark.parametrize("kind", ["nothing", "another start", "another system"])
def test_a_run_of_something_else_is_refused(kind: str) -> None:
    """Its gradient would be by other numbers than those that are turned."""
    system, y0 = net()
    variables = Variables(system, y0, ["mass"])
    other: Any = {
        "nothing": lambda system, y0: None,
        "another start": lambda system, y0: run(system, y0 + 1.0),
        "another system": lambda system, y0: run(net()[0], y0),
    }[kind]
    message = "run must return a Trajectory; got None" if kind == "nothing" else "run must simulate the system and the"
    with pytest.raises(ValueError, match=message):
        ReducedObjective(other, variables, path_objective)(2 * variables.start)
    with pytest.raises(ValueError, match=message):
        Residuals(other, variables, observed)(2 * variables.start)


def test_scipy_takes_both() -> None:
    """A ball thrown without drag: the velocity that hits is known in closed form, for symplectic Euler too."""
    system = System([1.0], Gravity([0.0, -10.0]), 2)
    target, h, steps = np.array([3.0, 1.0]), 0.01, 50
    aim = Variables(system, np.zeros(4), ["velocities"])
    throw = lambda system, y0: simulate(SymplecticEuler(), system, y0, h, steps)  # noqa: E731
    exact = [6.0, 2.0 + 0.5 * 10 * h * (steps + 1)]

    def miss(trajectory: Any) -> Any:
        gap = np.append(trajectory.last[:2] - target, [0.0, 0.0])
        return 0.5 * gap @ gap, gap

    found = scipy.optimize.minimize(ReducedObjective(throw, aim, miss), aim.start, jac=True)
    np.testing.assert_allclose(found.x, exact, atol=1e-5)

    def gap(trajectory: Any) -> Any:
        pick = np.zeros((2, trajectory.y.size))
        pick[[0, 1], [-4, -3]] = 1
        return trajectory.last[:2] - target, pick

    residuals = Residuals(throw, aim, gap)
    fitted = scipy.optimize.least_squares(residuals, aim.start, jac=residuals.jacobian)
    np.testing.assert_allclose(fitted.x, exact, atol=1e-10)


@pytest.mark.parametrize("kind", ["objective", "residuals"])
def test_an_optimisation_is_recorded(kind: str) -> None:
    ball = scenes.projectile()
    aim = Variables(ball.system, ball.y0, ["velocities"])
    throw = lambda system, y0: simulate(ball.stepper, system, y0, ball.h, ball.steps)  # noqa: E731

    def gap(trajectory: Any) -> Any:
        return np.append(trajectory.last[:2] - [3.0, 1.0], [0.0, 0.0])

    def miss(trajectory: Any) -> Any:
        return 0.5 * gap(trajectory) @ gap(trajectory), gap(trajectory)

    def both(trajectory: Any) -> Any:
        return gap(trajectory)[:2], eye_array(2, trajectory.y.size, k=trajectory.y.size - 4)

    fit: Any = Residuals(throw, aim, both) if kind == "residuals" else ReducedObjective(throw, aim, miss)
    seen: list[tuple[int, float, float]] = []
    found = optimise(fit, aim.start, report=lambda *line: seen.append(line))
    assert found.converged and found.value < 1e-8 and found.evaluations == len(seen) == found.result.nfev
    assert [line[0] for line in seen] == list(range(1, len(seen) + 1))
    np.testing.assert_array_equal(found.values, [line[1] for line in seen])
    assert found.best[-1] == found.values.min() and (np.diff(found.best) <= 0).all()
    assert np.isfinite(found.slopes[0]) and found.slopes[0] > found.slopes[-1]


def test_an_optimisation_prints_as_one_line() -> None:
    found = optimise(lambda p: (float(p @ p) / 2, p), np.ones(2000))
    assert str(found).startswith("objective 1e+03 -> ") and len(str(found)) < 120


def test_a_fit_without_its_gradient_is_told() -> None:
    with pytest.raises(ValueError, match=r"fit must return the tuple \(value, gradient\); got"):
        optimise(lambda p: p @ p, [1.0, 2.0])


def test_the_derivative_by_the_states_may_be_a_callable() -> None:
    """As `adjoint` takes it: with checkpoints the states are seen on the way back only."""
    variables = Variables(*net(), ["springs.stiffness"])
    whole = ReducedObjective(run, variables, lambda path: (0.0, path.y))
    sparing = ReducedObjective(
        lambda system, y0: simulate(BackwardEuler(), system, y0, H, STEPS, keep=Checkpoints(2)),
        variables,
        lambda path: (0.0, lambda n, y: y),
    )
    np.testing.assert_array_equal(sparing(variables.start)[1], whole(variables.start)[1])


def test_optimise_needs_numbers() -> None:
    with pytest.raises(ValueError, match="start must be finite"):
        optimise(lambda p: (0.0, p), [np.nan])


def test_an_optimisation_refuses_nan_and_forgives_infinity() -> None:
    """SciPy would go on with NaN to its last iteration."""
    with pytest.raises(ValueError, match="fit must return numbers, value and gradient; NaN in evaluation 1"):
        optimise(lambda p: (np.nan, p), [1.0])
    with pytest.raises(ValueError, match="NaN in evaluation 2"):
        optimise(lambda p: (float(p[0]), np.ones(1) if p[0] == 1 else np.full(1, np.nan)), [1.0])
    walled = optimise(lambda p: (p[0] - np.log(p[0]), 1 - 1 / p) if p[0] > 0 else (np.inf, 0 * p), [9.0], method="BFGS")
    assert walled.p == pytest.approx([1.0]) and np.isfinite(walled.best).all()


def test_what_is_left_of_residuals_is_half_their_square() -> None:
    class Two:
        def __call__(self, p: Array) -> Array:
            return np.array([p[0] - 1.0, p[0] + 1.0])

        def jacobian(self, p: Array) -> Array:
            return np.ones((2, 1))

    found = optimise(Two(), [0.5])
    assert found.value == pytest.approx(1.0) and found.values[-1] == pytest.approx(1.0)
