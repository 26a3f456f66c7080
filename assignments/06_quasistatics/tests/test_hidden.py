"""Hidden items: differences of places of rest, closed forms of the glued points, the least squares of SciPy."""

import importlib.util
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsim.grading import compare
from dsim.grading.student import ItemLost, kit_function

spec = importlib.util.spec_from_file_location("public_06", Path(__file__).with_name("test_public.py"))
public = importlib.util.module_from_spec(spec)
spec.loader.exec_module(public)

SEEDS = st.integers(0, 2**31)


def some_chain(rng):
    """A hanging chain with a jet at its end: two or three links."""
    links = int(rng.integers(2, 4))
    body = public.given("follower", links=links, weight=float(rng.uniform(2.5, 3.5)))
    return *body, np.append(rng.uniform(0.35, 0.45, links), rng.uniform(0.6, 1.0))


def some_bond(depth, width, part, k):
    """Two glued points, pulled with a part of what the glue can hold: body, p, and where they rest."""
    pull = part * depth * width / 2
    p = np.array([pull, k])
    first = pull / k
    stretch = -np.log((1 + np.sqrt(max(1 - part, 0.0))) / 2) / width
    return kit_function("bond", depth=depth, width=width), p, np.array([first, first + stretch])


BONDS = {"depth": st.floats(0.5, 2.0), "width": st.floats(1.0, 3.0), "k": st.floats(2.0, 10.0)}


@given(**BONDS, held=st.floats(0.9, 0.98), torn=st.floats(1.1, 2.0))
def test_no_equilibrium(student, depth, width, k, held, torn):
    body, p, x = some_bond(depth, width, held, k)
    compare.close("x*", student.call("equilibrium", body, np.zeros(2), p), x, 1e-7)
    body, p, _ = some_bond(depth, width, torn, k)
    if student.call("equilibrium", body, np.zeros(2), p) is not None:
        raise ItemLost("there is no equilibrium, so that None was asked for; something else was returned")


@given(seed=SEEDS)
def test_sensitivity_follower(student, seed):
    rng = np.random.default_rng(seed)
    public.sensitivity(student, *some_chain(rng), rng)


@given(seed=SEEDS)
def test_adjoint_follower(student, seed):
    rng = np.random.default_rng(seed)
    public.adjoint(student, *some_chain(rng), rng)


@given(seed=SEEDS, price=st.floats(0.5, 3.0))
def test_explicit(student, seed, price):
    """What the price adds to their gradient: price (p - usual), and nothing else."""
    rng = np.random.default_rng(seed)
    theirs, body, p = public.some_truss(rng)
    x, usual = public.rest(body, body.start(), p), p + rng.normal(size=2)
    goal = x + rng.normal(size=2)
    free, priced = (
        compare.array("dO/dp", student.call("adjoint_gradient", theirs, objective, x, p), p.shape)
        for objective in (
            kit_function("target", target=goal),
            kit_function("target", target=goal, price=price, usual=usual),
        )
    )
    compare.close("what the price adds to dO/dp", priced - free, price * (p - usual), 1e-9)


@given(**BONDS)
def test_fold(student, depth, width, k):
    """Beside the fold both functions are large; at it neither has a value."""
    objective = kit_function("target", target=np.zeros(2))
    body, p, x = some_bond(depth, width, 1.0 - 1e-8, k)
    growth = 1e4 / (depth * width**2)  # 1 / (d glue / ds) = 1 / (D a^2 sqrt(1 - part)), nearly
    found = compare.array("dx*/dp beside a fold", student.call("sensitivity", body, x, p), (2, 2))
    nearly("dx*/dp beside a fold", found[1, 0], growth)
    found = compare.array("dO/dp beside a fold", student.call("adjoint_gradient", body, objective, x, p), (2,))
    nearly("dO/dp beside a fold", found[0], growth * x[1])
    student.award(0.5)
    body, p, x = some_bond(depth, width, 1.0, k)
    for name, arguments in (("sensitivity", (body, x, p)), ("adjoint_gradient", (body, objective, x, p))):
        if student.call(name, *arguments) is not None:
            raise ItemLost(f"{name} must return None at a fold; something else came back")


def nearly(name, found, expected):
    """Of the right size, up to a factor of 4."""
    part = max(abs(found), 1e-9) / expected
    compare.at_most(f"{name}: the factor between what came and what is expected", max(part, 1 / part), 4.0)


@given(seed=SEEDS, make=st.sampled_from(["some_net", "some_truss"]))
def test_design_gradient(student, seed, make):
    """Value and gradient at rest, the gradient by their own adjoint, which has its own items."""
    rng = np.random.default_rng(seed)
    theirs, body, p = getattr(public, make)(rng)
    start = body.start()
    x = public.rest(body, start, p)
    wanted = {"target": x + rng.normal(size=x.shape), "price": 0.5, "usual": p + 0.1}
    objective = kit_function("target", **wanted)
    found = student.call("design_gradient", theirs, objective, start, p)
    found = compare.pair("design_gradient", found, "(O, dO/dp)")
    compare.close("O", compare.number("O", found[0]), public.kit.target(**wanted).value(x, p), 1e-8)
    student.award(0.5)
    expected = compare.array("adjoint_gradient", student.call("adjoint_gradient", theirs, objective, x, p), p.shape)
    if not expected.any():
        raise ItemLost("your adjoint_gradient is zero, and so cannot be the one of this design")
    compare.close("dO/dp, beside your adjoint_gradient at x*,", found[1], expected, 1e-6)


@given(seed=SEEDS, n=st.integers(2, 8), count=st.integers(1, 8), damping=st.floats(0.05, 0.5))
def test_gauss_newton(student, seed, n, count, damping):
    rng = np.random.default_rng(seed)
    slope, (x, target) = rng.normal(size=(n, count)), rng.normal(size=(2, n))
    stacked = np.vstack([slope, np.sqrt(damping) * np.eye(count)])
    expected = np.linalg.lstsq(stacked, np.append(target - x, np.zeros(count)), rcond=None)[0]
    compare.close("dp", student.call("gauss_newton_step", x, target, slope, damping), expected, 1e-8)
