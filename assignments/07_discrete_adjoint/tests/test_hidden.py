"""Hidden items: differences of steps, one large linear system instead of sweeps, whole trajectories."""

import importlib.util
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsim.grading import compare
from dsim.grading.student import ItemLost, kit_function

spec = importlib.util.spec_from_file_location("public_07", Path(__file__).with_name("test_public.py"))
public = importlib.util.module_from_spec(spec)
spec.loader.exec_module(public)

SEEDS, METHODS = st.integers(0, 2**31), st.sampled_from(["symplectic", "backward"])


@given(seed=SEEDS)
def test_backward_linearization(student, seed):
    public.linearization(student, "backward", np.random.default_rng(seed))


@given(seed=SEEDS)
def test_tangent(student, seed):
    rng = np.random.default_rng(seed)
    (A, B, C), dldy, dldu = public.some_sweep(rng)
    dy0, du, dp = rng.normal(size=A.shape[1]), rng.normal(size=dldu.shape), rng.normal(size=C.shape[2])
    pushes = np.vstack([dy0, np.einsum("kij,kj->ki", B, du) + C @ dp])
    found = compare.array("tangent", student.call("tangent", A, B, C, dy0, du, dp), dldy.shape)
    compare.close("row 0 of tangent", found[0], dy0, 0.0)
    compare.close("tangent", found, np.einsum("kilj,lj->ki", public.whole(A), pushes), 1e-10)


@given(seed=SEEDS)
def test_adjoint_running(student, seed):
    """What the costs before the last add to dJ/dy0: the last one has an item of its own."""
    matrices, dldy, dldu = public.some_sweep(np.random.default_rng(seed))
    without = public.last_only(dldy)
    theirs, ours = (
        call(dldy)[0] - call(without)[0]
        for call in (
            lambda given: public.adjoint(student, matrices, given, dldu),
            lambda given: public.expected(matrices, given, dldu),
        )
    )
    compare.close("what running costs add to dJ/dy0", theirs, ours, 1e-10)


@given(seed=SEEDS)
def test_adjoint_controls(student, seed):
    """Only the last state costs, and every control does."""
    matrices, dldy, dldu = public.some_sweep(np.random.default_rng(seed))
    dldy, free = public.last_only(dldy), np.zeros_like(dldu)
    found = public.adjoint(student, matrices, dldy, free)[1]
    compare.close("dJ/du", found, public.expected(matrices, dldy, free)[1], 1e-10)
    student.award(0.5)
    priced = public.adjoint(student, matrices, dldy, dldu)[1]
    compare.close("what a price adds to dJ/du", priced - found, dldu, 1e-10)


@given(seed=SEEDS)
def test_adjoint_parameters(student, seed):
    matrices, dldy, dldu = public.some_sweep(np.random.default_rng(seed))
    dldy = public.last_only(dldy)
    found = public.adjoint(student, matrices, dldy, dldu)[2]
    compare.close("dJ/dp", found, public.expected(matrices, dldy, dldu)[2], 1e-10)


def some_flight(rng, steps):
    """Arguments of `gradient` after the method: problem, y0, u, p; and the cost here, for values."""
    body, _, p, n = public.some_body(rng)
    y0, u, h = rng.normal(size=2 * n), rng.normal(size=(steps, n)), float(rng.uniform(0.05, 0.2))
    numbers = {
        "path": rng.normal(size=(steps + 1, 2 * n)), "weight": rng.uniform(0.5, 2.0, steps + 1), "price": 0.7
    }  # fmt: skip
    return ((body, kit_function("tracking", **numbers), h), y0, u, p), public.kit.tracking(**numbers)


def four(name, value, arguments):
    """J and the three gradients."""
    _, y0, u, p = arguments
    return public.parts(name, value, {"J": (), "dJ/dy0": y0.shape, "dJ/du": u.shape, "dJ/dp": p.shape})


def one_by_one(student, method, arguments, cost):
    """Their own steps and linearizations: J, (A, B, C), dldy, dldu.  A mistake in these costs their own items only."""
    (body, _, h), y0, u, p = arguments
    n, y, found = len(y0) // 2, [y0], []
    shapes = {"A": (2 * n, 2 * n), "B": (2 * n, n), "C": (2 * n, len(p))}
    for control in u:
        y.append(compare.array("y1", student.call(f"{method}_step", body, y[-1], control, p, h), y0.shape))
        if (y[-1] == y[-2]).all():
            raise ItemLost(f"your {method}_step moves nothing, so that there is no trajectory to look at")
        triple = student.call(f"{method}_linearization", body, y[-2], y[-1], p, h)
        found.append(public.parts(f"{method}_linearization", triple, shapes))
        for name, matrix in zip(shapes, found[-1], strict=True):
            if not matrix.any():
                raise ItemLost(f"{name} of your {method}_linearization is zero; it cannot be")
    value = sum(map(cost.state, range(len(y)), y)) + sum(map(cost.control, range(len(u)), u))
    dldy, dldu = (np.array(list(map(f, range(len(z)), z))) for f, z in ((cost.dldy, y), (cost.dldu, u)))
    return value, [np.array(matrices) for matrices in zip(*found, strict=True)], dldy, dldu


@given(seed=SEEDS, method=METHODS)
def test_gradient(student, seed, method):
    arguments, cost = some_flight(np.random.default_rng(seed), 3)
    found = four("gradient", student.call("gradient", method, *arguments), arguments)
    value, matrices, dldy, dldu = one_by_one(student, method, arguments, cost)
    compare.close("J", found[0], value, 1e-10)
    student.award(1 / 3)
    apart = public.adjoint(student, matrices, dldy, dldu)
    twice = public.adjoint(student, matrices, 2 * dldy, 2 * dldu)
    if any((one == two).all() for one, two in zip(apart, twice, strict=True)):
        raise ItemLost("your adjoint gives the same for other costs, and so cannot be the one of this trajectory")
    for name, theirs, expected in zip(("dJ/dy0", "dJ/du", "dJ/dp"), found[1:], apart, strict=True):
        if not expected.any():
            raise ItemLost(f"{name} is zero when your own functions are called one by one; it cannot be")
        compare.close(f"{name}, beside your own functions one by one,", theirs, expected, 1e-10)


@given(seed=SEEDS, steps=st.integers(3, 7), every=st.integers(2, 4), method=METHODS)
def test_checkpoints(student, seed, steps, every, method):
    arguments, cost = some_flight(np.random.default_rng(seed), steps)
    found = four("checkpointed_gradient", student.call("checkpointed_gradient", method, *arguments, every), arguments)
    value, *rest = one_by_one(student, method, arguments, cost)
    compare.close("J", found[0], value, 1e-12)
    student.award(1 / 4)
    for name, few, expected in zip(("dJ/dy0", "dJ/du", "dJ/dp"), found[1:], public.expected(*rest), strict=True):
        compare.close(f"{name}, beside the gradient from all states,", few, expected, 1e-12)
