"""Hidden items: differences of steps, one large linear system instead of sweeps, whole trajectories."""

import importlib.util
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsim.grading import compare
from dsim.grading.student import kit_function

spec = importlib.util.spec_from_file_location("public_07", Path(__file__).with_name("test_public.py"))
public = importlib.util.module_from_spec(spec)
spec.loader.exec_module(public)

SEEDS = st.integers(0, 2**31)


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
    """Arguments of `gradient` after the method: body, cost, y0, u, p, h; and the cost here, for values."""
    body, _, p, n = public.some_body(rng)
    y0, u, h = rng.normal(size=2 * n), rng.normal(size=(steps, n)), float(rng.uniform(0.05, 0.2))
    numbers = {
        "path": rng.normal(size=(steps + 1, 2 * n)), "weight": rng.uniform(0.5, 2.0, steps + 1), "price": 0.7
    }  # fmt: skip
    return (body, kit_function("tracking", **numbers), y0, u, p, h), public.kit.tracking(**numbers)


def four(name, value, arguments):
    """J and the three gradients."""
    _, _, y0, u, p, _ = arguments
    return public.parts(name, value, {"J": (), "dJ/dy0": y0.shape, "dJ/du": u.shape, "dJ/dp": p.shape})


@given(seed=SEEDS)
def test_gradient(student, seed):
    """Their own steps, linearizations and sweep, called one by one: a mistake in them costs their items only."""
    rng = np.random.default_rng(seed)
    for method in ("symplectic", "backward"):
        arguments, cost = some_flight(rng, 3)
        body, _, y0, u, p, h = arguments
        found = four("gradient", student.call("gradient", method, *arguments), arguments)
        y, matrices = [y0], []
        for control in u:
            y.append(student.call(f"{method}_step", body, y[-1], control, p, h))
            matrices.append(student.call(f"{method}_linearization", body, y[-2], y[-1], p, h))
        value = sum(map(cost.state, range(4), y)) + sum(map(cost.control, range(3), u))
        compare.close("J", found[0], value, 1e-10)
        dldy, dldu = np.array(list(map(cost.dldy, range(4), y))), np.array(list(map(cost.dldu, range(3), u)))
        swept = student.call("adjoint", *map(np.array, zip(*matrices, strict=True)), dldy, dldu)
        for name, theirs, apart in zip(("dJ/dy0", "dJ/du", "dJ/dp"), found[1:], swept, strict=True):
            compare.close(f"{name}, beside your own functions one by one,", theirs, apart, 1e-10)


@given(seed=SEEDS, steps=st.integers(3, 7), every=st.integers(2, 4), method=st.sampled_from(["symplectic", "backward"]))
def test_checkpoints(student, seed, steps, every, method):
    arguments, _ = some_flight(np.random.default_rng(seed), steps)
    found = four("checkpointed_gradient", student.call("checkpointed_gradient", method, *arguments, every), arguments)
    whole = four("gradient", student.call("gradient", method, *arguments), arguments)
    for name, few, all_states in zip(("J", "dJ/dy0", "dJ/du", "dJ/dp"), found, whole, strict=True):
        compare.close(f"{name}, beside your own gradient,", few, all_states, 1e-12)
