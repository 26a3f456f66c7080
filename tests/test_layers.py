"""Scenes inside networks: PyTorch's and JAX's own gradient checkers judge the layers."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import scipy.optimize

from dsim import Checkpoints, ReducedObjective, SimulationError, System, Variables, scenes, simulate
from dsim.effects import Drag, Gravity, Springs
from dsim.gradients.layers import jax_layer, torch_layer
from dsim.gradients.layers import torch as torch_module
from dsim.gradients.layers.state_map import StateMap, Tape
from dsim.simulation import record
from dsim.steppers import BDF2, BackwardEuler, SymplecticEuler

STEPS = 4
ABSENT = "is not installed: pip install -e '.[layers]'"
EACH = {"positions": [2, 5], "velocities": [3, 4], "mass": [1], "springs.stiffness": [0, 2], "drag.coefficient": [0],
        "drag.wind": [1]}  # fmt: skip


@pytest.fixture
def torch() -> Any:
    return pytest.importorskip("torch", reason=f"torch {ABSENT}")


@pytest.fixture
def jax() -> Iterator[Any]:
    """JAX with float64."""
    jax = pytest.importorskip("jax", reason=f"jax {ABSENT}")
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield jax
    jax.config.update("jax_enable_x64", before)


def triangle(wrt: Any = EACH) -> Variables:
    springs = Springs([(0, 1), (1, 2), (0, 2)], 0.9, [8.0, 9.0, 10.0])
    system = System([1.0, 2.0, 1.5], [Gravity([0.0, -9.81]), Drag(0.3, [1.0, 0.5]), springs], 2, fixed=[0])
    return Variables(system, [0, 0, 1, 0.1, 0.4, -1, 0, 0, 1, 2, 0.5, 0.3], wrt)


def by(stepper: Any, keep: Any = "states", h: float = 0.05) -> Callable[..., Any]:
    return lambda system, y0: simulate(stepper, system, y0, h, STEPS, keep)


def batch(variables: Variables, rows: int = 3) -> Any:
    return variables.start * np.random.default_rng(0).uniform(0.8, 1.2, (rows, len(variables)))


def squares(trajectory: Any) -> Any:
    return (trajectory.y**2).sum() / 2, trajectory.y


def recorded(system: Any, y0: Any) -> Any:
    return record(SymplecticEuler(), system, y0, 0.05, STEPS)


class Counted:
    """A run that counts."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, system: Any, y0: Any) -> Any:
        self.calls += 1
        return by(SymplecticEuler())(system, y0)


CASES: dict[str, tuple[Any, Any]] = {
    "backward Euler, path": (by(BackwardEuler()), "path"),
    "BDF2, path": (by(BDF2()), "path"),
    "symplectic Euler, path": (by(SymplecticEuler()), "path"),
    "backward Euler, last, checkpoints": (by(BackwardEuler(), Checkpoints(2)), "last"),
    "symplectic Euler, last": (by(SymplecticEuler()), "last"),
}
WRONG: dict[str, Callable[..., Any]] = {
    "1% too long": lambda right, scene, trajectory, bar: 1.01 * right(scene, trajectory, bar),
    "one entry's sign": lambda right, scene, trajectory, bar: right(scene, trajectory, bar) * [*[1] * 8, -1],
    "states in the wrong order": lambda right, scene, trajectory, bar: right(scene, trajectory, bar[::-1]),
    "the path's last state alone": lambda right, scene, trajectory, bar: right(scene, trajectory, bar[-1]),
}


def plant(monkeypatch: Any, bug: str) -> None:
    right = StateMap.pullback
    monkeypatch.setattr(StateMap, "pullback", lambda *given: WRONG[bug](right, *given))


# PyTorch


@pytest.mark.parametrize("case", CASES)
def test_torch_gradcheck(case: str, torch: Any) -> None:
    run, output = CASES[case]
    variables = triangle()
    layer = torch_layer(run, variables, output)
    for p in (variables.start, batch(variables, 2)):
        assert torch.autograd.gradcheck(layer, torch.tensor(p, requires_grad=True), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("bug", WRONG)
def test_torch_gradcheck_sees_a_wrong_backward(bug: str, torch: Any, monkeypatch: Any) -> None:
    plant(monkeypatch, bug)
    variables = triangle()
    p = torch.tensor(variables.start, requires_grad=True)
    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        torch.autograd.gradcheck(torch_layer(by(SymplecticEuler()), variables), p, atol=1e-6, rtol=1e-5)


def test_torch_backward_is_the_adjoint(torch: Any) -> None:
    """To the bits; on one forward run; as often as the graph is kept."""
    variables, run = triangle(), Counted()
    layer = torch_layer(run, variables)
    p = torch.tensor(variables.start, requires_grad=True)
    assert layer(p).shape == (STEPS + 1, 12) and run.calls == 2  # one of them for the number of steps
    loss = (layer(p) ** 2).sum() / 2
    loss.backward(retain_graph=True)
    assert run.calls == 3
    value, gradient = ReducedObjective(run, variables, squares)(variables.start)
    np.testing.assert_array_equal(p.grad, gradient)
    assert loss.item() == pytest.approx(value, rel=1e-14)
    loss.backward()
    np.testing.assert_array_equal(p.grad, 2 * gradient)
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        loss.backward()


def test_torch_batches_are_single_runs(torch: Any) -> None:
    variables = triangle()
    layer = torch_layer(by(SymplecticEuler()), variables)
    p = torch.tensor(batch(variables, 6).reshape(2, 3, -1), requires_grad=True)
    y = layer(p)
    assert y.shape == (2, 3, STEPS + 1, 12) and layer(p[:0]).shape == (0, 3, STEPS + 1, 12)
    weights = torch.tensor(np.random.default_rng(1).normal(size=y.shape))
    (weights * y).sum().backward()
    for i, j in np.ndindex(2, 3):
        one = p[i, j].detach().requires_grad_()
        alone = layer(one)
        (weights[i, j] * alone).sum().backward()
        assert torch.equal(alone, y[i, j]) and torch.equal(one.grad, p.grad[i, j])


def test_torch_float32(torch: Any) -> None:
    variables = triangle()
    layer = torch_layer(by(BackwardEuler()), variables, "last")
    p = torch.tensor(variables.start, dtype=torch.float32, requires_grad=True)
    exact = p.detach().double().requires_grad_()
    assert layer(p).dtype == torch.float32
    for given in (p, exact):
        layer(given).square().sum().backward()
    assert p.grad.dtype == torch.float32
    np.testing.assert_allclose(p.grad, exact.grad, rtol=1e-5)


def test_torch_without_gradients(torch: Any) -> None:
    variables = triangle()
    layer = torch_layer(by(SymplecticEuler()), variables)
    assert not layer(torch.tensor(variables.start)).requires_grad
    p = torch.tensor(variables.start, requires_grad=True)
    with torch.no_grad():
        assert not layer(p).requires_grad
    assert list(layer.parameters()) == [] and layer.state_dict() == {}
    assert "drag.wind (9) -> path" in str(torch.nn.Sequential(torch.nn.Linear(2, 9), layer))


@pytest.mark.parametrize("weight", [1.0, 2.0])
def test_torch_second_derivatives_are_refused(weight: float, torch: Any) -> None:
    """Also of a sum of states, whose cotangent is constant: no silent zero."""
    variables = triangle()
    p = torch.tensor(variables.start, requires_grad=True)
    (slope,) = torch.autograd.grad(
        (torch_layer(by(SymplecticEuler()), variables)(p) ** weight).sum(), p, create_graph=True
    )
    with pytest.raises(RuntimeError, match=r"differentiated once; for second derivatives .* ReducedObjective"):
        (slope.sum() + p.sum()).backward()


@pytest.mark.parametrize("run", [by(SymplecticEuler()), recorded], ids=["simulate", "record"])
def test_torch_run_that_fails(run: Any, torch: Any) -> None:
    variables = triangle(["springs.stiffness"])
    layer = torch_layer(run, variables)
    p = torch.tensor(batch(variables))
    p[1, 0] = 1e200
    with pytest.raises(SimulationError, match=r"SymplecticEuler failed in step \d .*not_finite") as failed:
        layer(p)
    assert failed.value.status == "not_finite"


def test_torch_bad_input(torch: Any) -> None:
    variables = triangle()
    layer = torch_layer(by(SymplecticEuler()), variables)
    p = torch.tensor(variables.start)
    bad: dict[str, Any] = {
        r"p must have shape \(\.\.\., 9\); got \(4,\)": p[:4],
        r"p must have shape \(\.\.\., 9\); got \(\)": p[0],
        "float64 or float32; got torch.int64": p.long(),
        "float64 or float32; got torch.float16": p.half(),
        "float64 or float32; got float64": variables.start,
        "float64 or float32; got list": list(variables.start),
        "p must be finite; got nan at index 0": p * float("nan"),
    }
    for message, given in bad.items():
        with pytest.raises(ValueError, match=message):
            layer(given)
    with pytest.raises(ValueError, match="dJdy must be finite"):
        (layer(p.requires_grad_()) * float("nan")).sum().backward()


# JAX


@pytest.mark.parametrize("case", CASES)
def test_jax_check_grads(case: str, jax: Any) -> None:
    from jax.test_util import check_grads

    run, output = CASES[case]
    variables = triangle()
    layer = jax_layer(run, variables, output)
    check_grads(layer, (variables.start,), order=1, modes=["rev"])
    check_grads(jax.jit(layer), (variables.start,), order=1, modes=["rev"])
    check_grads(jax.jit(jax.vmap(layer)), (batch(variables),), order=1, modes=["rev"])


@pytest.mark.parametrize("bug", WRONG)
def test_jax_check_grads_sees_a_wrong_backward(bug: str, jax: Any, monkeypatch: Any) -> None:
    from jax.test_util import check_grads

    plant(monkeypatch, bug)
    variables = triangle()
    with pytest.raises(AssertionError, match="VJP cotangent projection"):
        check_grads(jax_layer(by(SymplecticEuler()), variables), (variables.start,), 1, ["rev"], rtol=1e-4)


@pytest.mark.parametrize("compiled", [False, True])
def test_jax_backward_is_the_adjoint(compiled: bool, jax: Any) -> None:
    """To the bits, on one forward run; batches are single runs."""
    variables, run = triangle(), Counted()
    layer = jax_layer(run, variables)
    slope = jax.grad(lambda p: (layer(p) ** 2).sum() / 2)
    slope = jax.jit(slope) if compiled else slope
    found = slope(variables.start)
    assert run.calls == 2  # one of them for the number of steps
    gradient = ReducedObjective(run, variables, squares)(variables.start)[1]
    np.testing.assert_array_equal(found, gradient)
    assert layer(variables.start).shape == (STEPS + 1, 12)
    p = batch(variables)
    np.testing.assert_array_equal(jax.vmap(slope)(p), [slope(row) for row in p])


def test_jax_jacobian(jax: Any) -> None:
    """Many cotangents on one run: vmap over the backward alone."""
    variables, run = triangle(), Counted()
    layer = jax_layer(run, variables)
    whole = jax.jacrev(layer)(variables.start)
    assert whole.shape == (STEPS + 1, 12, 9) and run.calls == 2
    picked = jax.grad(lambda p: layer(p)[3, 4])(variables.start)
    np.testing.assert_allclose(whole[3, 4], picked, rtol=1e-12)


def test_jax_float32(jax: Any) -> None:
    variables = triangle()
    layer = jax_layer(by(BackwardEuler()), variables, "last")
    slope = jax.grad(lambda p: (layer(p) ** 2).sum())
    p = variables.start.astype(np.float32)
    assert layer(p).dtype == slope(p).dtype == np.float32
    exact = slope(p.astype(np.float64))
    for found in (slope(p), jax.jit(slope)(p)):
        np.testing.assert_allclose(found, exact, rtol=1e-5)
    jax.config.update("jax_enable_x64", False)
    np.testing.assert_allclose(jax.jit(slope)(p), exact, rtol=1e-5)


def test_jax_second_derivatives_are_refused(jax: Any) -> None:
    variables = triangle()
    layer = jax_layer(by(SymplecticEuler()), variables)
    for total in (lambda p: layer(p).sum(), lambda p: (layer(p) ** 2).sum()):
        with pytest.raises(ValueError, match=r"differentiated once; for second derivatives .* ReducedObjective"):
            jax.grad(lambda p: jax.grad(total)(p).sum())(variables.start)  # noqa: B023
        with pytest.raises(TypeError, match="forward-mode"):
            jax.hessian(total)(variables.start)


@pytest.mark.parametrize("run", [by(SymplecticEuler()), recorded], ids=["simulate", "record"])
def test_jax_run_that_fails(run: Any, jax: Any) -> None:
    variables = triangle(["springs.stiffness"])
    layer = jax_layer(run, variables)
    p = batch(variables)
    p[1, 0] = 1e200
    message = r"SymplecticEuler failed in step \d .*not_finite"
    for given in (layer, jax.grad(lambda p: layer(p).sum())):
        with pytest.raises(SimulationError, match=message) as failed:
            given(p[1])
        assert failed.value.status == "not_finite"
    for given in (lambda p: jax.jit(layer)(p[1]), jax.vmap(layer)):
        with pytest.raises(jax.errors.JaxRuntimeError, match=message):
            given(p).block_until_ready()


def test_jax_bad_input(jax: Any) -> None:
    variables = triangle()
    layer = jax_layer(by(SymplecticEuler()), variables)
    bad: dict[str, Any] = {
        r"p must have shape \(9,\); got \(4,\)": variables.start[:4],
        r"got \(3, 9\); for a batch use jax.vmap": batch(variables),
        "float64 or float32; got int64": np.arange(9),
        "p must be finite; got nan at index 0": variables.start * np.nan,
    }
    for message, given in bad.items():
        with pytest.raises(ValueError, match=message):
            layer(given)
    with pytest.raises(ValueError, match=r"p must have shape \(9,\)"):
        jax.jit(layer)(variables.start[:4])


def test_jax_trains_a_network(jax: Any) -> None:
    """It learns the speed of a throw from the target; a hundredth of the first loss, on targets it has not seen."""
    from jax.flatten_util import ravel_pytree

    ball = scenes.projectile(h=0.05, steps=20)
    throw = Variables(ball.system, ball.y0, ["velocities"])
    fly = jax_layer(lambda system, y0: simulate(ball.stepper, system, y0, ball.h, ball.steps), throw, "last")
    rng = np.random.default_rng(0)
    weights = [rng.normal(size=(2, 8)) / 2, np.zeros(8), rng.normal(size=(8, 2)) / 3, np.zeros(2)]
    flat, shaped = ravel_pytree(weights)
    targets = rng.uniform([3, -1], [6, 2], (20, 2))

    def loss(flat: Any, targets: Any) -> Any:
        first, shift, second, end = shaped(flat)
        velocity = targets + jax.numpy.tanh(targets @ first + shift) @ second + end
        return ((jax.vmap(fly)(velocity)[:, :2] - targets) ** 2).sum(axis=1).mean()

    both = jax.jit(jax.value_and_grad(loss))

    def numbers(flat: Any) -> Any:
        value, slope = both(flat, targets[:8])
        return float(value), np.asarray(slope)

    found = scipy.optimize.minimize(numbers, flat, jac=True, method="L-BFGS-B", options={"maxiter": 30})
    assert found.fun < 1e-2 * numbers(flat)[0]
    assert loss(found.x, targets[8:]) < 1e-2 * loss(flat, targets[8:])


# without either library


@pytest.mark.parametrize("layer", [torch_layer, jax_layer], ids=["torch", "jax"])
def test_missing_library(layer: Any, monkeypatch: Any) -> None:
    package = layer.__name__.removesuffix("_layer")
    monkeypatch.setitem(sys.modules, package, None)  # as on a machine that does not have it
    torch_module._module.cache_clear()
    with pytest.raises(ImportError, match=rf"{layer.__name__} needs .*: pip install {package}, or .*'dsim\[layers\]'"):
        layer(by(SymplecticEuler()), triangle())


def test_the_map_in_numpy() -> None:
    """The layers' two halves, on every machine: <bar, J dp> = <J^T bar, dp> with J dp by central differences."""
    variables = triangle()
    rng = np.random.default_rng(2)
    for run, output in CASES.values():
        scene = StateMap(run, variables, output)
        y = scene.states(scene.trajectory(variables.start))
        assert y.shape == scene.shape
        bar, dp, step = rng.normal(size=y.shape), rng.normal(size=len(variables)), 1e-5
        ahead, behind = (scene.states(scene.trajectory(variables.start + s * dp)) for s in (step, -step))
        slope = np.vdot(bar, ahead - behind) / (2 * step)
        assert slope == pytest.approx(scene.pullback(scene.trajectory(variables.start), bar) @ dp, rel=1e-7)


def test_the_tape_forgets_the_oldest() -> None:
    """Within its bytes no run is made twice; beyond them it is, with the same bits."""
    variables, run = triangle(), Counted()
    scene = StateMap(run, variables, "last")
    p, bar = batch(variables), np.ones(12)
    size = scene.trajectory(p[0]).tape_bytes
    wide, narrow = Tape(scene), Tape(scene, limit=2 * size)
    found = []
    for tape, more in ((wide, 3), (narrow, 4)):
        before = run.calls
        for row in p:
            tape.states(row)
        found.append([tape.pullback(row, bar) for row in p[::-1]])
        assert run.calls == before + more
    np.testing.assert_array_equal(*found)
    assert len(narrow._kept) == 2 and Tape(scene, limit=0).states(p[0]).shape == (12,)


BAD_MAPS: dict[str, tuple[Callable[[], Any], str]] = {
    "run": (lambda: StateMap(None, triangle()), "run must be a callable"),  # type: ignore[arg-type]
    "variables": (lambda: StateMap(by(BDF2()), ["mass"]), "variables must be Variables"),  # type: ignore[arg-type]
    "output": (lambda: StateMap(by(BDF2()), triangle(), "end"), 'output must be "path" or "last"; got \'end\''),  # type: ignore[arg-type]
    "answer": (lambda: StateMap(lambda *_: 1.0, triangle()).shape, "run must return a trajectory; got 1.0"),  # type: ignore[arg-type]
    "checkpoints": (
        lambda: StateMap(lambda *_: 0, triangle(), "path").states(
            by(BDF2(), Checkpoints(2))(*triangle().place(triangle().start))
        ),  # type: ignore[arg-type]
        "this trajectory keeps Checkpoints",
    ),
}


@pytest.mark.parametrize("case", BAD_MAPS)
def test_bad_maps(case: str) -> None:
    do, message = BAD_MAPS[case]
    with pytest.raises(ValueError, match=message):
        do()


def test_every_run_takes_the_same_steps() -> None:
    def run(system: Any, y0: Any) -> Any:
        return simulate(SymplecticEuler(), system, y0, 0.05, STEPS + (system.mass[1] > 2.1))

    scene = StateMap(run, triangle(["mass"]))
    with pytest.raises(ValueError, match=r"same number of steps for every p; got \(6, 12\) after \(5, 12\)"):
        scene.trajectory([1.0, 2.2, 1.5])
