"""Public items; `dsim check-submission` runs them.  `student.call("f", ...)` calls your function f."""

import importlib.util
from pathlib import Path

import numpy as np

from dsim.grading import compare
from dsim.grading.student import ItemLost, kit_function

spec = importlib.util.spec_from_file_location("kit_07", Path(__file__).parents[1] / "kit.py")
kit = importlib.util.module_from_spec(spec)
spec.loader.exec_module(kit)

TOLERANCE = 1e-6  # of differences


def some_body(rng, name=None):
    """A body for your functions, the same here, and its parameters."""
    name = name or ("swimmer", "pendulums")[rng.integers(2)]
    numbers = {"swimmer": {"mass": float(rng.uniform(0.5, 2.0))}, "pendulums": {"count": int(rng.integers(1, 4))}}[name]
    body = getattr(kit, name)(**numbers)
    parameters = rng.uniform(0.5, 2.0, 4 if name == "swimmer" else 3)
    return kit_function(name, **numbers), body, parameters, len(body.mass)


def symplectic(body, y, u, p, h):
    x, v = np.split(y, 2)
    v = v + h * (body.force(x, v, p) + u) / body.mass
    return np.concatenate([x + h * v, v])


def backward(body, y, u, p, h):
    """Newton's method on the whole state at once, the equations divided by nothing."""
    n, new, (K, D) = len(u), y, (body.dfdx, body.dfdv)
    mass, one = np.diag(body.mass), np.eye(len(u))
    for _ in range(12):
        x, v = np.split(new, 2)
        wrong = np.append(x - y[:n] - h * v, mass @ (v - y[n:]) - h * (body.force(x, v, p) + u))
        if np.abs(wrong).max() < 1e-13:
            break
        new = new - np.linalg.solve(np.block([[one, -h * one], [-h * K(x, v, p), mass - h * D(x, v, p)]]), wrong)
    return new


STEPS = {"symplectic": symplectic, "backward": backward}


def slope(f, z, direction):
    """The derivative of f at z along a direction, by central differences."""
    e = 1e-5
    return (f(z + e * direction) - f(z - e * direction)) / (2 * e)


def parts(name, value, shapes):
    """The entries of a tuple, as arrays of these shapes."""
    if not isinstance(value, tuple | list) or len(value) != len(shapes):
        raise ItemLost(f"{name} must return {len(shapes)} values, {', '.join(shapes)}")
    return [compare.array(f"{part} of {name}", v, s) for (part, s), v in zip(shapes.items(), value, strict=True)]


def step(student, method, rng):
    theirs, body, p, n = some_body(rng)
    y, u, h = rng.normal(size=2 * n), rng.normal(size=n), float(rng.uniform(0.05, 0.2))
    y1 = compare.array(f"{method}_step", student.call(f"{method}_step", theirs, y, u, p, h), (2 * n,))
    y2 = STEPS[method](body, y, u, p, h)
    compare.close(f"v of {method}_step", y1[n:], y2[n:], 1e-9)
    student.award(0.5)
    compare.close(f"x of {method}_step", y1[:n], y2[:n], 1e-9)


def test_symplectic_step(student):
    for seed in (1, 2, 3):
        step(student, "symplectic", np.random.default_rng(seed))


def linearization(student, method, rng):
    """Their A, B and C along directions, against differences of the step."""
    theirs, body, p, n = some_body(rng)
    y, u, h = rng.normal(size=2 * n), rng.normal(size=n), float(rng.uniform(0.1, 0.3))
    one = STEPS[method]
    found = student.call(f"{method}_linearization", theirs, y, one(body, y, u, p, h), p, h)
    shapes = {"A": (2 * n, 2 * n), "B": (2 * n, n), "C": (2 * n, len(p))}
    places = {"A": y, "B": u, "C": p}
    matrices = parts(f"{method}_linearization", found, shapes)
    for name, matrix, part in zip(shapes, matrices, (0.5, 0.75, 0.75), strict=True):
        direction = rng.normal(size=matrix.shape[1])
        differences = slope(lambda z, n=name: one(body, *({**places, n: z}.values()), h), places[name], direction)
        compare.close(f"{name} of {method}_linearization", matrix @ direction, differences, TOLERANCE)
        student.award(part)


def test_symplectic_linearization(student):
    for seed in (1, 2, 3, 4):
        linearization(student, "symplectic", np.random.default_rng(seed))


def test_backward_step(student):
    for seed in (1, 2, 3):
        step(student, "backward", np.random.default_rng(seed))


def some_sweep(rng):
    """Linearizations of N steps that nobody took, and derivatives of costs."""
    steps, n, count = int(rng.integers(3, 6)), int(rng.integers(1, 4)), int(rng.integers(1, 4))
    size = 2 * n
    A, B, C = (rng.normal(size=(steps, size, k)) / np.sqrt(size) for k in (size, n, count))
    return (A, B, C), rng.normal(size=(steps + 1, size)), rng.normal(size=(steps, n))


def whole(A):
    """Every dy_k from every push, as one matrix: the inverse of a block bidiagonal one.  No sweep is needed."""
    steps, size, _ = A.shape
    chain = np.eye((steps + 1) * size).reshape(steps + 1, size, steps + 1, size)
    for k in range(steps):
        chain[k + 1, :, k] = -A[k]
    return np.linalg.inv(chain.reshape((steps + 1) * size, -1)).reshape(chain.shape)


def expected(matrices, dldy, dldu):
    """dJ/dy0, dJ/du and dJ/dp through that matrix."""
    A, B, C = matrices
    lam = np.einsum("ki,kilj->lj", dldy, whole(A))
    return lam[0], dldu + np.einsum("ki,kij->kj", lam[1:], B), np.einsum("ki,kij->j", lam[1:], C)


def adjoint(student, matrices, dldy, dldu):
    """Their three gradients."""
    (_, size, n), count = matrices[1].shape, matrices[2].shape[2]
    found = student.call("adjoint", *matrices, dldy, dldu)
    return parts("adjoint", found, {"dJ/dy0": (size,), "dJ/du": (len(dldu), n), "dJ/dp": (count,)})


def last_only(dldy):
    """Only the last state costs."""
    return np.concatenate([np.zeros_like(dldy[:-1]), dldy[-1:]])


def test_adjoint_state(student):
    for seed in (1, 2, 3):
        matrices, dldy, dldu = some_sweep(np.random.default_rng(seed))
        dldy = last_only(dldy)
        compare.close("dJ/dy0", adjoint(student, matrices, dldy, dldu)[0], expected(matrices, dldy, dldu)[0], 1e-10)
