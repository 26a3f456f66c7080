"""Every showcase succeeds by its own measure; a wrong gradient and an optimiser that does nothing are red."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from dsim import catalog, sensitivity, simulate
from dsim.arrays.checks import Array
from dsim.cli import app, main
from dsim.gradients import Optimisation, Residuals, adjoint
from dsim.pictures.showcases import convergence
from dsim.pictures.style import to_png
from dsim.report import showcases as report
from dsim.report.sections import jobs
from dsim.steppers import SymplecticEuler
from dsim.studies.check import Check
from dsim.studies.derivatives import EffectExample, check_effect
from dsim.studies.showcases import control, identification, targeting
from dsim.studies.showcases.model import Showcase, Turned, select, slope_error
from dsim.studies.showcases.muscles import Muscles
from dsim.system import System


def red(checks: Any) -> list[str]:
    return [f"{c.statement}: {c.measured} {c.bound}" for c in checks if not c.passed]


# Every row


# What is promised, and from where: a looser bound is another promise.
REACHED = {
    "control": {("gradient against a difference", "<= 1e-05"), ("start value / value", ">= 100")},
    "targeting": {("RMS miss of the corners, m", "<= 0.005"), ("start value / value", ">= 10000")},
    "identification": {("springs within 1 %, of those seen", ">= 0.99"), ("springs within 1 % at the start", "<= 0.1")},
}


# Here the quick ones alone: `dsim verify` runs every row in its quick form.
# The formwork in full has a test of its own.
IN_FULL = [pytest.param(row, False, marks=pytest.mark.slow) for row in catalog.SHOWCASES if row.name != "formwork"]
QUICK = [pytest.param(row, True) for row in catalog.SHOWCASES if row.name in ("targeting", "identification")]


@pytest.mark.parametrize(("row", "quick"), QUICK + IN_FULL, ids=lambda value: getattr(value, "name", str(value)))
def test_a_showcase_succeeds_and_is_drawn(row: Showcase, quick: bool) -> None:
    told: list[tuple[int, int, str]] = []
    result = row.run(quick, lambda *state: told.append(state))
    assert result.checks() and not red(result.checks())
    assert REACHED.get(row.name, set()) <= {(check.statement, check.bound) for check in result.checks()}
    assert result.optimisation.value < result.optimisation.values[0] and result.optimisation.evaluations > 1
    assert told and all(0 <= done <= total and text for done, total, text in told)
    assert to_png(row.draw(result), dpi=30).startswith(b"\x89PNG")
    assert len(convergence(result.optimisation, row.name).axes) == 2


def test_the_rows() -> None:
    assert {"control", "identification", "targeting"} <= {row.name for row in catalog.SHOWCASES}
    assert all(row.statement and len(row.statement) <= 90 for row in catalog.SHOWCASES)
    assert select(catalog.SHOWCASES, "control").name == "control"
    with pytest.raises(ValueError, match=r"NAME must be one of control, .*; got 'contrl'; did you mean control\?"):
        select(catalog.SHOWCASES, "contrl")


# Mutations: what must be red


def flipped(fit: Any) -> Any:
    return lambda z: (fit(z)[0], -fit(z)[1])


def small_trunk() -> control.Trunk:
    return control.trunk(1, 0.06, 100.0, 0.01, 15)


def failed(result: Any) -> dict[str, float]:
    return {check.statement: check.measured for check in result.checks() if not check.passed}


def test_control_by_a_flipped_gradient_or_not_at_all_is_red() -> None:
    task = small_trunk()
    found = failed(control.steered(task, 1, fit=flipped(task.contracted())))
    assert found["gradient against a difference"] == pytest.approx(2, abs=1e-6)
    assert found["RMS miss of the tip, m"] > 0.02
    found = failed(control.steered(task, 0))
    assert list(found) == ["RMS miss of the tip, m", "start value / value", "the same by RK4 at h/2, m"]
    assert found["start value / value"] < 1.5


def test_targeting_by_a_flipped_gradient_or_not_at_all_is_red() -> None:
    task = targeting.throw(3)
    task = replace(task, scene=replace(task.scene, steps=2))
    found = failed(targeting.aimed(task, 1, fit=flipped(task.thrown())))
    assert found["gradient against a difference"] == pytest.approx(2, abs=1e-6)
    assert found["start value / value"] == 1
    assert failed(targeting.aimed(task, 0))["start value / value"] == 1


class Flipped(Residuals):
    def jacobian(self, p: Any) -> Array:
        return -super().jacobian(p)


def stopped(*arguments: Any, **options: Any) -> Optimisation:
    return optimise(*arguments, **options | {"max_nfev": 1})


optimise = identification.optimise
estimate = identification.estimate


def confident(*fit: Any) -> identification.Estimate:
    """A pseudo-inverse that takes what it cannot know for known."""
    found = estimate(*fit)
    return replace(found, unknown=np.zeros_like(found.unknown))


SABOTAGE: dict[str, tuple[Any, ...]] = {
    "a flipped Jacobian": ("Residuals", Flipped, "Jacobian against a difference", "springs within 1 %, of those seen"),
    "stopped at the start": ("optimise", stopped, "springs within 1 %, of those seen"),
    "bars too short": ("LEVEL", 0.7, "bars along known directions"),
    "bars too long": ("LEVEL", 0.9999, "bars along known directions"),
    "false confidence": ("estimate", confident, "springs wrongly called known or unknown: 3.0"),
}


def identified() -> identification.Identification:
    return identification.identified(identification.net(4, 12), 4)


def test_a_small_identification_is_green() -> None:
    assert not red(identified().checks())


def test_bars_that_miss_the_truth_are_red() -> None:
    found = identified()
    missed = replace(found, coverage=replace(found.coverage, hits=np.zeros_like(found.coverage.hits)))
    assert [line for line in red(missed.checks()) if "bars that reach the truth" in line]


@pytest.mark.parametrize("name", SABOTAGE)
def test_a_sabotaged_identification_is_red(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    place, value, *statements = SABOTAGE[name]
    monkeypatch.setattr(identification, place, value)
    lines = red(identified().checks())
    assert all(any(statement in line for line in lines) for statement in statements), lines


# What the showcases are made of


def test_muscles_are_a_right_effect() -> None:
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4)]

    def make(rng: np.random.Generator, points: int, d: int) -> Muscles:
        return Muscles(pairs, rng.uniform(0.5, 2, (3, 4)), rng.uniform(1, 5, 4), 0.02)

    checks = check_effect(EffectExample("muscles", make))
    assert len(checks) >= 12 and not red(checks)


def test_rows_of_muscles_carry_the_gradient_of_the_plain_path() -> None:
    task = control.trunk(1, 0.06, 100.0, 0.01, 4)
    rng = np.random.default_rng(0)
    system: Any = task.scene.system
    system = system.with_theta(system.theta * rng.uniform(0.9, 1.1, system.parameter_count))
    run = simulate(SymplecticEuler(), system, task.scene.y0, 0.01, 4)
    weights, direction = rng.normal(size=run.y.shape), rng.normal(size=system.parameter_count)
    assert run.run is not None  # on rows; the sensitivity goes step by step
    by_adjoint = adjoint(run, weights).theta @ direction
    by_sensitivity = (weights * sensitivity(run, None, direction)).sum()
    assert by_adjoint == pytest.approx(by_sensitivity, rel=1e-11)
    own = adjoint(run, weights)["muscles.rest_length"]
    assert own.shape == (4, 12) and (own[:3] != 0).all()


def test_muscles_alone_move_no_body() -> None:
    rng = np.random.default_rng(1)
    muscles = Muscles([(0, 1), (1, 2), (2, 0)], rng.uniform(0.3, 2, (50, 3)), 40.0, 0.01)
    system = System([1.0, 2.0, 3.0], muscles, dimension=2)
    run = simulate(SymplecticEuler(), system, np.append(rng.normal(size=6), np.zeros(6)), 0.01, 50)
    momentum = (run.v.reshape(51, 3, 2) * system.mass[:, None]).sum(axis=1)
    assert np.abs(run.v).max() > 0.1 and np.abs(momentum).max() < 1e-12


def test_bad_muscles() -> None:
    with pytest.raises(ValueError, match="rest_length must be > 0"):
        Muscles([(0, 1)], [[1.0], [0.0]], 40.0, 0.01)
    with pytest.raises(ValueError, match=r"rest_length must have shape \(any, 1\)"):
        Muscles([(0, 1)], [[1.0, 1.0]], 40.0, 0.01)
    muscles = Muscles([(0, 1)], [[1.0], [2.0]], 40.0, 0.01)
    assert [muscles.row(t) for t in (0.0, 0.01, 0.0199, 0.02)] == [0, 1, 1, 1]
    with pytest.raises(ValueError, match=r"muscles has 2 rows of h = 0\.01; got t = 0\.03"):
        muscles.row(0.03)


def test_a_net_in_a_steady_wind_flies_as_the_closed_form_says() -> None:
    """Forces between points cancel and drag is linear: the centre moves like one point.

    With s = m/c and u = wind + s g:  x(T) - x(0) = u T + (v0 - u) s (1 - e^(-T/s)).
    """
    wind = np.array([-2.0, 1.0, 0.0])
    found = targeting.aimed(targeting.throw(3, wind, None))
    s, T = targeting.MASS / targeting.DRAG, found.throw.scene.duration
    u = wind + s * np.array([0.0, 0.0, -targeting.G])
    v0 = u + (targeting.BULLSEYE - targeting.HAND - u * T) / (s * -np.expm1(-T / s))
    centre = found.after.last[:27].reshape(9, 3).mean(axis=0)
    np.testing.assert_allclose(centre, targeting.BULLSEYE, atol=2e-3)
    np.testing.assert_allclose(found.velocity, v0, atol=3e-3)


def test_the_wind_has_its_derivative() -> None:
    x, e = np.array([[1.0, 2.0, 0.7], [0.0, 1.0, 2.5]]), 1e-6
    for axis in range(3):
        step = e * np.eye(3)[axis]
        difference = (targeting.gusts(0.4, x + step) - targeting.gusts(0.4, x - step)) / (2 * e)
        np.testing.assert_allclose(targeting.gusts_jacobian(0.4, x)[:, :, axis], difference, atol=1e-9)


def test_turned_variables_and_their_slope() -> None:
    rng = np.random.default_rng(0)
    fit = Turned(lambda p: (float((p**4).sum()), 4 * p**3), rng.normal(size=(5, 2)), rng.normal(size=5))
    z = rng.normal(size=2)
    assert slope_error(fit, z) < 1e-6
    assert slope_error(flipped(fit), z) == pytest.approx(2, abs=1e-6)


# Error bars


def test_bars_of_a_linear_fit_are_those_of_the_textbook() -> None:
    """cov = s^2 (J^T J)^-1, of which the square roots of the diagonal are taken."""
    rng = np.random.default_rng(0)
    J, p, r = rng.normal(size=(40, 4)), rng.uniform(1, 2, 4), rng.normal(size=40)
    found = identification.estimate(p, J, r)
    covariance = r @ r / 36 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(found.bars, 2.0281 * np.sqrt(np.diag(covariance)), rtol=1e-4)  # t of 36 at 97.5 %
    error = rng.normal(size=4)
    distance = (found.along(p - error) ** 2).sum()
    assert distance == pytest.approx(error @ np.linalg.solve(covariance, error))


def test_what_the_data_cannot_tell_has_an_infinite_bar() -> None:
    """Columns 0 and 1 are equal, column 2 is zero: only the sum of the first two is known, and column 3."""
    rng = np.random.default_rng(1)
    J = rng.normal(size=(30, 4))
    J[:, 1], J[:, 2] = J[:, 0], 0.0
    found = identification.estimate(np.array([1.0, 2.0, 1.0, 1.0]), J, rng.normal(size=30))
    assert np.isinf(found.bars).tolist() == [True, True, True, False] and found.axes.shape == (4, 2)
    assert found.covers(np.array([50.0, -7.0, 1e9, found.stiffness[3]])).all()


def test_a_refit_ends_at_the_least_squares_solution() -> None:
    film = identification.net(4, 16)
    seen = film.exact + identification.NOISE * np.random.default_rng(5).normal(size=film.exact.shape)
    found = identification.refit(film, seen, film.truth)
    other = optimise(film.residuals(seen), film.truth, bounds=(1.0, 1e4), **identification.STRICT)
    seen_ones = ~film.hidden
    off = np.abs(found.stiffness - other.p)[seen_ones] / found.bars[seen_ones]
    assert off.max() < 1e-2


def test_limits_of_a_count_are_binomial() -> None:
    low, high = identification.binomial_limits(20, risk=0.1, rate=0.7)
    chance = [comb(20, k) * 0.7**k * 0.3 ** (20 - k) for k in range(21)]
    k, most = round(20 * low), round(20 * high)
    assert sum(chance[:k]) <= 0.05 < sum(chance[: k + 1])
    assert sum(chance[most + 1 :]) <= 0.05 < sum(chance[most:])


# The command


@dataclass(frozen=True)
class Stub:
    """A result without a simulation."""

    passed: bool = True

    @property
    def optimisation(self) -> Optimisation:
        values, slopes = np.array([8.0, 2.0, 0.0]), np.array([1.0, np.nan, 0.0])
        return Optimisation(np.zeros(2), 0.0, values, slopes, True, "DONE.", None)

    def checks(self) -> tuple[Check, ...]:
        return (Check("stub", "distance, m", self.passed, 0.25, "<= 1"),)


def stub(passed: bool = True) -> Showcase:
    def run(quick: bool, tell: Any) -> Stub:
        tell(1, 2, "half")
        return Stub(passed)

    return Showcase("stub", "nothing at all", run, lambda result: Figure())


def command(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["optimise", *arguments])


def test_without_a_name_they_are_listed() -> None:
    result = command()
    assert result.exit_code == 0 and all(row.name in result.stdout for row in catalog.SHOWCASES)
    assert all(len(line) <= 80 for line in result.stdout.splitlines())


def test_pictures_are_written_where_they_are_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalog, "SHOWCASES", (stub(),))
    monkeypatch.chdir(tmp_path)
    assert command("stub").exit_code == 0 and not list(tmp_path.iterdir())
    result = command("stub", "--to", str(tmp_path / "out"), "--full")
    assert result.exit_code == 0 and "objective 8 -> 0 in 3 evaluations. Done." in result.stdout
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["stub.png", "stub_convergence.svg"]
    assert all(len(line) <= 80 for line in result.stdout.splitlines() if "out" not in line)
    assert command("stub", "--quiet").stderr == ""


def test_a_red_showcase_exits_with_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalog, "SHOWCASES", (stub(passed=False),))
    result = command("stub")
    assert result.exit_code == 1 and "FAIL" in result.stdout


def test_bad_usage_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(catalog, "SHOWCASES", (stub(),))
    for arguments, line in (
        (["stab"], "dsim: NAME must be one of stub; got 'stab'; did you mean stub?"),
        (["stub", "--to", str(tmp_path / "file")], f"dsim: --to must be a directory; {tmp_path / 'file'} is a file"),
    ):
        monkeypatch.setattr("sys.argv", ["dsim", "optimise", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2 and capsys.readouterr().err.strip() == line


def test_the_section_of_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalog, "SHOWCASES", (stub(passed=False),))
    told: list[str] = []
    section = report.showcases(told.append)
    assert told == ["stub", "half"] and len(section.checks) == len(section.failed) == 1
    assert len(section.pictures) == 2 and "showcases" in [job.key for job in jobs()]


def test_the_list_is_what_no_name_shows() -> None:
    bare, listed = CliRunner().invoke(app, ["optimise"]), CliRunner().invoke(app, ["optimise", "--list"])
    assert listed.exit_code == 0 and listed.output == bare.output and "tumbling" in listed.output
