"""What accuracy costs: the truth, the analysis, the stopwatch, and the command."""

import json
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from typer.testing import CliRunner

from dsim import catalog
from dsim.cli import app, main
from dsim.effects import Field
from dsim.pictures.style import to_png
from dsim.pictures.work_precision import estimated_cost
from dsim.pictures.work_precision import work_precision as draw
from dsim.report import accuracy as report
from dsim.report.accuracy import newton_curves, select, tables
from dsim.scenes.pendulum import GRAVITY
from dsim.simulation import simulate
from dsim.steppers import RK4, BackwardEuler, ForwardEuler, RuleStepper, SymplecticEuler, VelocityVerlet
from dsim.studies import check_gradient, problems, stopwatch, tolerances
from dsim.studies import work_precision as module
from dsim.studies.cells import Store
from dsim.studies.convergence import fit_order
from dsim.studies.problems import Problem, adjoint_equation, sample, solution
from dsim.studies.reference import DOP853, RADAU, Reference
from dsim.studies.work_precision import Cell, Study, Sweep, asymptotic_order, cost_at, measure, pareto, work_precision
from dsim.system import System

TINY = Sweep(levels=2, costly=2, rounds=0)
CLOSED = [problems.projectile, problems.kepler, problems.chain, problems.two_rates]


def cell(method, setting, error, seconds=1.0, status="converged", **more):
    counts = {"forces": int(10 * seconds)}
    return Cell("p", method, setting, 10, status, error, error, 0.0, counts, seconds, seconds, **more)


# The truth


@pytest.mark.parametrize("build", [*CLOSED, problems.pendulum], ids=lambda b: b.__name__)
def test_closed_forms_agree_with_an_integrator(build):
    problem = build()
    numerical = solution(problem, Reference("DOP853", 1e-9))
    for t in np.linspace(0, problem.duration, 25):
        assert np.abs((problem.exact(t) - numerical(t)) / problem.scale).max() < 1e-6


@pytest.mark.parametrize("build", CLOSED, ids=lambda b: b.__name__)
def test_gradients_in_closed_form_agree_with_the_adjoint_equation(build):
    problem = build()
    gradient = adjoint_equation(problem, Reference("DOP853", 1e-8), problem.exact(problem.duration))
    assert problem.gradient_error(gradient, problem.truth().gradient) < 1e-5


@pytest.mark.parametrize("factor, verdict", [(1.0, "smooth"), (1.001, "wrong")])
def test_the_reference_gradient_is_the_derivative_of_the_reference_solution(factor, verdict):
    problem = problems.pendulum()

    def final(y0):
        return problem.objective(solution(replace(problem, y0=y0, exact=None), DOP853)(problem.duration))

    gradient = factor * problem.truth().gradient
    assert check_gradient(lambda y0: final(y0), problem.y0, gradient=gradient).verdict == verdict


def test_the_rigid_pendulum_of_the_protocol():
    assert problems.pendulum().exact(1.3 / np.sqrt(GRAVITY))[0] == pytest.approx(1.202368656359, abs=1e-11)


def test_a_method_never_judges_itself():
    problem = problems.pendulum()
    assert problem.truth("DOP853").name == "Radau" and problem.truth("Radau").name == "DOP853"
    assert problem.truth("RK4").name == "DOP853"


def test_a_wrong_truth_shows_as_a_plateau():
    good, exact = problems.projectile(), problems.projectile().exact
    bad = replace(good, exact=lambda t: exact(t) * (1 + 1e-3))
    errors = [measure(p, RK4(), 256).error for p in (good, bad)]
    assert errors[0] < 1e-10 and errors[1] > 1e-5


def test_a_wrong_gradient_shows_as_a_plateau():
    good = problems.projectile()
    bad = replace(good, transposed_flow=lambda mu: 1.01 * good.transposed_flow(mu))
    errors = [measure(p, RK4(), 256).gradient_error for p in (good, bad)]
    assert errors[0] < 1e-10 and errors[1] > 5e-3


# Sampling


def test_at_least_twenty_times_and_the_last_one():
    for steps in (32, 100, 1000):
        chosen = sample(np.linspace(0, 3.0, steps + 1), 3.0)
        assert len(chosen) >= 18 and chosen[-1] == steps and chosen[0] > 0
    assert len(sample(np.linspace(0, 3.0, 101), 3.0)) >= 20


def test_symplectic_euler_at_a_whole_period_fakes_order_two():
    exact = lambda t: np.array([np.cos(t), -np.sin(t)])  # noqa: E731
    spring = problems.line("s", np.ones(1), np.array([1.0, 0.0]), (np.ones(1), np.zeros(1)), 2 * np.pi)
    h, at_period, ours = [], [], []
    for steps in (64, 128, 256, 512):
        run = simulate(SymplecticEuler(), spring.system, spring.y0, spring.duration / steps, steps)
        h.append(run.h)
        at_period.append(np.abs(run.y[-1] - spring.exact(0.0)).max())
        ours.append(spring.state_error(run.t, run.y))
    assert spring.exact(1.0)[[1, 4]] == pytest.approx(exact(1.0))
    assert fit_order(h, at_period).order == pytest.approx(2, abs=0.2)
    assert fit_order(h, ours).order == pytest.approx(1, abs=0.1)


# Analysis


def test_order_on_the_asymptotic_window():
    h = 2.0 ** -np.arange(10)
    error = h**2
    error[:2] = [0.1, 0.3]  # before the asymptotic regime
    error[-1] = 2 * error[-2]  # round-off
    fit = asymptotic_order(list(h), list(error))
    assert fit.order == pytest.approx(2, abs=1e-9) and len(fit.h) == 6 and fit.r_squared > 0.999
    assert asymptotic_order([1.0, 0.5], [1.0, 0.5]) is None
    assert asymptotic_order([], []) is None


def test_pareto_front():
    assert pareto([3.0, 1.0, 2.0, 2.0], [1e-3, 1e-1, 1e-1, 1e-2]) == [1, 3, 0]
    assert pareto([], []) == []


def test_costs_are_interpolated_and_never_extrapolated():
    cost, error = np.array([1.0, 100.0]), np.array([1e-2, 1e-6])
    assert cost_at(cost, error, 1e-4) == pytest.approx(10.0)
    assert cost_at(cost, error, 1e-7) is None
    assert cost_at(cost, error, 1e-1) == 1.0


def test_not_reached_ties_and_clipping():
    band = {"band": (0.9, 1.2)}
    runs = [
        *(cell("a", h, h**2, 1 / h, **band) for h in (0.1, 0.01)),
        *(cell("b", h, h**2, 1.1 / h, **band) for h in (0.1, 0.01)),
        cell("c", 0.1, 1e-13, 5000.0, **band),
    ]
    study = Study("p", tuple(runs), 1e-14, 1e-14)
    answer = study.cheapest(1e-3)
    assert answer.method == "a" and answer.ties == ("b",) and str(answer) == "a (= b)"
    assert study.cheapest(1e-8).method == "c"  # clipped, yet better than asked for
    assert study.points("c")[1].tolist() == [1e-12]  # not 1e-13: the truth is not known that well
    assert not study.cheapest(1e-13).reached


def test_failures_are_cells_and_crosses():
    problem = problems.two_rates()
    study = work_precision(problem, [ForwardEuler(), BackwardEuler()], TINY)
    failed = [c for c in study.cells if c.failed]
    assert {c.method for c in failed} == {"ForwardEuler"} and all(c.error == np.inf for c in failed)
    assert len(study.of("ForwardEuler")) == 2 and len(study.points("ForwardEuler")[0]) == 0
    figure = draw(study)
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert len(crosses) == 1 and len(crosses[0].get_xdata()) == 2
    assert min(crosses[0].get_ydata()) > max(c.error for c in study.cells if not c.failed)
    assert estimated_cost(study, failed[0]) > 0
    assert to_png(figure, 40).startswith(b"\x89PNG")
    json.dumps(study.to_dict(), allow_nan=False)


def test_newtons_cap_is_a_failure_too():
    stuck = measure(problems.kepler(), BackwardEuler(max_iterations=1), 128)
    assert stuck.failed and stuck.status == "max_iterations" and stuck.gradient_error == np.inf


# Measurement


@pytest.mark.parametrize(
    "method, forces", [(ForwardEuler(), 1), (SymplecticEuler(), 1), (VelocityVerlet(), 2), (RK4(), 4)]
)
def test_counts_of_explicit_methods_are_exact(method, forces):
    counts = measure(problems.projectile(), method, 32).counts
    assert counts["forces"] == 32 * forces
    assert not any(counts[k] for k in ("jacobians", "factorizations", "solves", "newton_iterations"))


def test_references_report_counts_and_converge():
    coarse, fine = (measure(problems.pendulum(), DOP853, tol) for tol in (1e-4, 1e-8))
    assert fine.error < coarse.error and fine.gradient_error < 1e-5 and fine.counts["forces"] > 0
    radau = measure(problems.projectile(), RADAU, 1e-4)
    assert radau.counts["factorizations"] > 0 and radau.error < 1e-3


def test_finished_cells_are_not_measured_again(tmp_path, monkeypatch):
    calls, original = [], module.measure
    monkeypatch.setattr(module, "measure", lambda *a: calls.append(a[2]) or original(*a))
    methods, problem = [RK4(), SymplecticEuler()], problems.projectile()
    first = work_precision(problem, methods, TINY, Store(tmp_path))
    assert len(calls) == 4
    second = work_precision(problem, methods, TINY, Store(tmp_path))
    assert len(calls) == 4 and first.to_dict() == second.to_dict()
    work_precision(problem, [RK4(), BackwardEuler()], TINY, Store(tmp_path))
    assert len(calls) == 6  # the newcomer alone
    next(tmp_path.glob("*.json")).write_text("{half a ce")
    work_precision(problem, methods, TINY, Store(tmp_path))
    work_precision(problem, methods, TINY, Store(tmp_path, fresh=True))
    assert len(calls) in (10, 11)


@pytest.mark.parametrize("text", ["{}", "[]", "3", '{"error": 1.0}', '{"cell": {"a": 1.0}, "digest": "0"}'])
def test_a_damaged_cell_is_measured_again(text, tmp_path):
    """Whatever it reads as: a store is a user's directory."""
    Store(tmp_path).put({"a": 2.5, "b": [1, None]}, "key")
    assert Store(tmp_path).get("key") == {"a": 2.5, "b": [1, None]}
    next(tmp_path.glob("*.json")).write_text(text)
    assert Store(tmp_path).get("key") is None


def test_results_need_a_directory(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="--to must be a directory"):
        report.run(["gradients"], tmp_path / "file", quick=True)


def test_an_interrupted_run_leaves_finished_cells(tmp_path, monkeypatch):
    original, calls = module.measure, []

    def interrupted(*a):
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(a)
        return original(*a)

    methods, problem = [RK4(), SymplecticEuler()], problems.projectile()
    monkeypatch.setattr(module, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        work_precision(problem, methods, TINY, Store(tmp_path))
    again = []
    monkeypatch.setattr(module, "measure", lambda *a: again.append(a) or original(*a))
    work_precision(problem, methods, TINY, Store(tmp_path))
    assert len(again) == 1 and not list(tmp_path.glob("*.partial"))


def test_seconds_come_with_a_control():
    study = work_precision(problems.projectile(), [RK4(), ForwardEuler()], Sweep(1, 1, rounds=1))
    assert study.unit == "seconds" and study.band[0] <= 1 <= study.band[1]
    for found in study.cells:
        timing = found.timing["state"]
        assert (
            0 < timing["least"] <= timing["median"]
            and found.seconds > 0
            and timing["repeats"] >= 2
            and timing["ratio"] > 0
        )
        assert timing["low"] <= timing["median"] <= timing["high"] and found.gradient_seconds > 0


def test_the_stopwatch_interleaves_and_restores(monkeypatch):
    order = []
    runs = {name: lambda name=name: order.append(name) for name in "AB"}
    monkeypatch.setattr(stopwatch, "CHUNK", 0.0)
    timings, band = stopwatch.time_interleaved(runs, lambda: order.append("c"), rounds=1)
    assert order[4:] == ["c", "A", "B", "c", "c", "B", "A", "c"] and band[0] <= 1 <= band[1]
    assert set(timings) == {"A", "B"} and stopwatch.gc.isenabled()


def test_two_of_a_kind_need_labels():
    with pytest.raises(ValueError, match="different names"):
        work_precision(problems.projectile(), [RK4(), RK4()], TINY)


def test_a_users_stepper_in_five_lines():
    @dataclass(frozen=True)
    class Heun(RuleStepper):
        order = 2

        def rule(self, y, phi, t, h):
            slope = phi(t, y[0])
            return y[0] + h / 2 * (slope + phi(t + h, y[0] + h * slope))

    study = work_precision(problems.projectile(), [RK4(), Heun()], Sweep(6, rounds=0))
    assert study.order("Heun").order == pytest.approx(2, abs=0.15)
    assert study.order("Heun", "gradient").order == pytest.approx(2, abs=0.15)
    assert study.cheapest(1e-6).method == "RK4"


# Curves


def test_newtons_tolerance_reaches_a_plateau():
    for tol, error, algebraic in newton_curves(40).values():
        assert error[-1] == pytest.approx(error[-4], rel=1e-3) and tol[-1] < 1e-6 * error[-1]
        assert algebraic[0] > 1e3 * algebraic[-1] and algebraic[-1] < 1e-9


def test_the_v_of_differences():
    errors = tolerances.difference_steps()
    assert 1e-10 < errors["forward"].min() < 1e-7
    assert 1e-13 < errors["central"].min() < 1e-9
    assert errors["complex"][:10].max() < 1e-15


# The command


def test_referees_of_every_problem_are_two_unrelated_references_of_the_catalog():
    for build in catalog.PROBLEMS:
        one, two = build().references
        assert one.method != two.method and {one, two} <= set(catalog.REFERENCES)


def test_the_command_writes_everything_and_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "QUICK", Sweep(2, 1, rounds=1))
    monkeypatch.setattr(report, "methods", lambda problem: (RK4(), BackwardEuler(), DOP853))
    arguments = ["accuracy", "projectile", "--quick", "--to", str(tmp_path / "out")]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 0, first.output
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"projectile.png", "projectile.svg", "table.txt", "accuracy.json", "cells"} <= names
    told = " ".join(first.output.split()).rpartition("┘")[2]  # what is printed below the tables
    assert all(name in told for name in names if not name.endswith(".svg") and name != "cells")
    data = json.loads((tmp_path / "out/accuracy.json").read_text())
    assert data["studies"][0]["problem"] == "projectile" and data["versions"]["numpy"] == np.__version__
    text = (tmp_path / "out/table.txt").read_text()
    assert max(map(len, text.splitlines())) <= 80 and "-: too few points" in " ".join(text.split())
    assert re.search(r"DOP853 +│ - ", text)
    monkeypatch.setattr(module, "measure", lambda *a: pytest.fail("measured again"))
    monkeypatch.setattr(report, "newton_curves", lambda *a: pytest.fail("drawn again"))
    assert CliRunner().invoke(app, arguments).exit_code == 0


def test_an_unknown_problem_is_one_clear_line(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["dsim", "accuracy", "keplr"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "did you mean kepler?" in message and len(message.splitlines()) == 1


def test_an_interruption_says_how_to_go_on(monkeypatch, tmp_path):
    def stop(*a, **k):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "run", stop)
    done = CliRunner().invoke(app, ["accuracy", "--to", str(tmp_path)])
    assert done.exit_code == 2 and "go on" in done.output


def test_the_catalog_has_the_problems():
    names = [build.__name__ for build in catalog.PROBLEMS]
    assert names[:6] == ["projectile", "pendulum", "kepler", "chain", "two_rates", "cloth"]
    assert names[6:] == ["free_top", "heavy_top"]
    assert [p.name for p in select(["two-rates"])] == ["two-rates"]


def test_tables_hold_a_row_a_method():
    study = work_precision(problems.projectile(), [RK4(), SymplecticEuler()], TINY)
    methods, answers = tables(study)
    assert len(methods.rows) == 2 and len(answers.rows) == 7


def test_a_reference_that_gives_up_is_a_failed_cell():
    pole = Field(lambda x: 6 * x**2, lambda x: 12 * x[:, :, None], lambda x: -2 * x[:, 0] ** 3)  # x = 1 / (1 - t)^2
    safe = Problem("pole", System([1.0], [pole], dimension=1), np.array([1.0, 2.0]), 2.0)
    cell = measure(safe, DOP853, 1e-6)
    assert cell.failed and cell.status == "gave up" and cell.error == np.inf


def test_the_store_notices_another_formula_and_another_force(tmp_path):
    def study(w, rule):
        class Mine(RuleStepper):
            order = 1

        Mine.rule = rule
        swing = Field(lambda x: -(w**2) * x, lambda x: np.full((1, 1, 1), -(w**2)))
        problem = Problem("osc", System([1.0], [swing], dimension=1), np.array([1.0, 0.0]), 1.0)
        return work_precision(problem, [Mine()], Sweep(2, 2, rounds=0), Store(tmp_path)).cells[0].error

    def euler(self, y, phi, t, h):
        return y[0] + h * phi(t, y[0])

    def midpoint(self, y, phi, t, h):
        return y[0] + h * phi(t + h / 2, y[0] + h / 2 * phi(t, y[0]))

    errors = [study(1.0, euler), study(1.0, midpoint), study(3.0, euler), study(1.0, euler)]
    assert len(set(errors)) == 3 and errors[0] == errors[3]
