"""Fabric formwork: the fabric, the objective's derivatives, a known design, and a design that succeeds."""

from dataclasses import replace

import numpy as np
import pytest

from dsim.pictures.formwork import before_after
from dsim.pictures.style import to_png
from dsim.solve.newton import Status
from dsim.studies.showcases import formwork as module
from dsim.studies.showcases.formwork import FormworkProblem, Places, TwoBellies, fabric, formwork, run


def red(result):
    return [check.statement for check in result.checks() if not check.passed]


@pytest.fixture(scope="module")
def quick():
    told = []
    result = run(True, lambda *line: told.append(line))
    return result, told


# The fabric and the target


def test_the_fabric():
    cloth = fabric(21)
    assert cloth.unknowns == (1083, 3112) and len(cloth.inner) == 19**2
    assert np.isclose(cloth.system.mass[cloth.inner].sum(), module.LOAD * (19 * 0.1) ** 2)
    fixed = np.setdiff1d(np.arange(21**2), cloth.inner)
    assert np.allclose(np.abs(cloth.flat[fixed, :2]).max(axis=1), module.SPAN / 2)
    assert not np.isin(cloth.edges, fixed).all(axis=1).any()


@pytest.mark.parametrize("target", [TwoBellies(), Places(np.arange(12.0).reshape(4, 3))], ids=["bellies", "places"])
def test_the_slope_of_a_target(target):
    x = np.random.default_rng(0).uniform(-1, 1, (4, 3))
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        difference = (target.gap(x + step) - target.gap(x - step)) / 2e-6
        assert np.allclose(target.slope(x)[:, :, axis], difference, atol=1e-8)


def test_the_target_hangs_in_the_frame():
    edge = np.linspace(-1, 1, 9)
    assert np.array_equal(TwoBellies().height(edge, np.ones(9)), np.zeros(9))
    x = np.column_stack([edge, 0.5 * edge, TwoBellies().height(edge, 0.5 * edge)])
    assert not TwoBellies().gap(x).any()


# The objective


def problem():
    """At an odd place, where some threads are slack."""
    task = FormworkProblem(fabric(5), TwoBellies())
    low, high = task.bounds
    z = np.random.default_rng(5).uniform(0.9 * low, 0.9 * high)
    assert task.equilibrium(z).status is Status.CONVERGED
    assert 0 < (task.strain(task.equilibrium(z)) < 0.01).sum() < len(task.rest)
    return task, z


def test_the_jacobian_against_differences_and_its_transpose():
    task, z = problem()
    rng = np.random.default_rng(6)
    d, w = rng.normal(size=len(z)), rng.normal(size=len(task(z)))
    difference = (task(z + 1e-6 * d) - task(z - 1e-6 * d)) / 2e-6
    jacobian = task.jacobian(z)
    assert np.allclose(jacobian.matvec(d), difference, rtol=1e-5, atol=1e-6 * np.abs(difference).max())
    assert np.isclose(w @ jacobian.matvec(d), d @ jacobian.rmatvec(w), rtol=1e-10)
    value, gradient = task.value_and_gradient(z)
    assert value == 0.5 * task(z) @ task(z) and np.allclose(gradient, jacobian.rmatvec(task(z)))


def test_no_rest_is_infinitely_bad(monkeypatch):
    task, z = problem()
    monkeypatch.setattr(module, "record", lambda system, q: replace(task.last, status=Status.NO_EQUILIBRIUM))
    assert np.isinf(task(1.01 * z)).all() and np.isnan(task.rms(task.last))


# Designs


def test_a_known_design_is_found_again():
    """The target is another fabric's equilibrium: it can be met to round-off but for the weak pull to the start."""
    cloth = fabric(5)
    hidden = FormworkProblem(cloth, TwoBellies())
    z = 0.3 * np.sin(np.arange(2.0 * len(cloth.edges)))
    places = hidden.equilibrium(z).q.reshape(-1, 3)[cloth.inner]
    result = formwork(5, 8, Places(places))
    assert result.rms(result.before) > 1e-3 and result.rms(result.after) < 3e-5


def test_the_small_design_succeeds(quick):
    result, told = quick
    assert not red(result), result.checks()
    assert result.optimisation.evaluations == len(result.distances) == len(told) == 16
    assert told[-1][:2] == (16, 16) and "of the span off" in told[-1][2]
    assert result.distances[0] > 50 * result.distances[-1]
    assert result.rms(result.after) == pytest.approx(result.distances[result.optimisation.values.argmin()], rel=1e-6)


def test_its_picture(quick):
    figure = before_after(quick[0])
    labels = {text for axes in figure.axes for text in (axes.get_xlabel(), axes.get_ylabel()) if text}
    assert {"x (m)", "height (m)", "RMS distance / span", "distance from the target (mm)"} <= labels
    assert to_png(figure, dpi=40).startswith(b"\x89PNG")


@pytest.mark.slow
def test_the_full_design_succeeds():
    result = run(False)
    freedom, unknowns = result.problem.fabric.unknowns
    assert freedom >= 1000 and unknowns >= 1000 and not red(result), result.checks()


# Mutations


class Uphill(FormworkProblem):
    """Its derivative has the wrong sign."""

    def jacobian(self, z):
        return -1.0 * super().jacobian(z)


class Inexact(FormworkProblem):
    """Its derivative forgets that rest lengths act on the equilibrium too."""

    def spread(self, z):
        spread = super().spread(z).copy()
        spread.data[spread.indices < len(z) // 2] *= 0.9
        return spread


@pytest.mark.parametrize("wrong", [Uphill, Inexact])
def test_a_wrong_gradient_is_red(wrong):
    result = formwork(5, 3, problem=wrong)
    assert "gradient against a difference" in red(result)


def test_a_design_cut_short_is_red():
    assert "RMS distance / span, designed" in red(formwork(5, 2))


def test_every_check_can_be_red(quick):
    result, _ = quick
    start = np.zeros_like(result.z)
    pushed = replace(result.after, q=result.after.q + 0.1 * result.after.system.free, status=Status.SINGULAR)
    spoilt = {
        "RMS distance / span, uniform": replace(result, before=result.after),
        "an unknown beyond its bound": replace(result, optimisation=replace(result.optimisation, p=start + 9.0)),
        "force left / a point's weight": replace(result, after=pushed),
        "a stable equilibrium": replace(result, after=pushed),
        "smallest strain of a thread": replace(result, after=replace(result.after, q=0.5 * result.after.q)),
    }
    for statement, worse in spoilt.items():
        assert statement in red(worse)


# Bad input


@pytest.mark.parametrize(
    ("n", "evaluations", "message"),
    [(2, 5, "n must be a whole number >= 3; got 2"), (5, 0, "evaluations must be a whole number >= 1; got 0")],
)
def test_bad_input(n, evaluations, message):
    with pytest.raises(ValueError, match=message):
        formwork(n, evaluations)
