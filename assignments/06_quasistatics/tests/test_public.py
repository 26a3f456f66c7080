"""Public items; `dsim check-submission` runs them.  `student.call("f", ...)` calls your function f."""

import importlib.util
from pathlib import Path

import numpy as np
from scipy.optimize import root

from dsim.grading import compare
from dsim.grading.student import kit_function

spec = importlib.util.spec_from_file_location("kit_06", Path(__file__).parents[1] / "kit.py")
kit = importlib.util.module_from_spec(spec)
spec.loader.exec_module(kit)


def given(name, **numbers):
    """A body of the kit: for your functions, and here."""
    return kit_function(name, **numbers), getattr(kit, name)(**numbers)


def rest(body, x, p):
    """Where the body is at rest, by another program than yours: MINPACK's, and a last step of Newton's."""
    x = root(body.force, x, args=(p,), jac=body.dfdx, tol=1e-14).x
    return x - np.linalg.solve(body.dfdx(x, p), body.force(x, p))


def beside(body, x, p):
    """Where the body is at rest, for parameters a little beside those that it is at rest at x for."""
    for _ in range(5):
        f = body.force(x, p)
        if np.abs(f).max() < 1e-13:
            break
        x = x - np.linalg.solve(body.dfdx(x, p), f)
    return x


def slope(f, p, direction):
    """The derivative of f at p along a direction, by central differences."""
    h = 1e-5
    return (f(p + h * direction) - f(p - h * direction)) / (2 * h)


def some_net(rng):
    """A net and its rest lengths."""
    return *given("net", weight=float(rng.uniform(1.0, 2.0))), rng.uniform(0.42, 0.48, 12)


def some_truss(rng):
    """Two bars in compression and their rest lengths."""
    lean, height = rng.uniform(-0.15, 0.15), rng.uniform(0.5, 0.8)
    body = given("truss", lean=float(lean), height=float(height))
    return *body, np.hypot([1 + lean, 1 - lean], height) * rng.uniform(0.99, 1.02, 2)


def test_equilibrium(student):
    rng = np.random.default_rng(1)
    for award, make in ((0.5, some_net), (1.0, some_truss)):
        theirs, body, p = make(rng)
        start = body.start()
        x = compare.array("x*", student.call("equilibrium", theirs, start, p), start.shape)
        compare.at_most("the largest |f| at x* (N)", float(np.abs(body.force(x, p)).max()), 1.001e-9)
        student.award(award)


def sensitivity(student, theirs, body, p, rng):
    """Their dx*/dp along a direction, against differences of places of rest."""
    x, direction = rest(body, body.start(), p), rng.normal(size=len(p))
    found = compare.array("dx*/dp", student.call("sensitivity", theirs, x, p), (len(x), len(p)))
    expected = slope(lambda p: beside(body, x, p), p, direction)
    compare.close("dx*/dp along one direction", found @ direction, expected, 1e-6)


def test_sensitivity(student):
    rng = np.random.default_rng(2)
    sensitivity(student, *some_net(rng), rng)
    student.award(0.5)
    sensitivity(student, *some_truss(rng), rng)


def adjoint(student, theirs, body, p, rng):
    """Their dO/dp, against differences of O at places of rest; p costs nothing here."""
    x = rest(body, body.start(), p)
    wanted = {"target": x + rng.normal(size=x.shape)}
    objective = kit.target(**wanted)
    found = student.call("adjoint_gradient", theirs, kit_function("target", **wanted), x, p)
    expected = [slope(lambda p: objective.value(beside(body, x, p), p), p, one) for one in np.eye(len(p))]
    compare.close("dO/dp", found, expected, 1e-6)


def test_adjoint(student):
    rng = np.random.default_rng(3)
    adjoint(student, *some_net(rng), rng)
    student.award(0.5)
    adjoint(student, *some_truss(rng), rng)
