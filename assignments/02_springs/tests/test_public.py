"""Public items; `dsim check-submission` runs them.  `student.call("f", ...)` calls your function f."""

import numpy as np

from dsim.grading import compare


def net(seed, dimension=3):
    """Five points, seven springs, several at every point: stretched ones and pressed ones."""
    rng = np.random.default_rng(seed)
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 4], [4, 0]])
    x, v = rng.normal(size=(2, 5, dimension))
    return x, v, pairs, rng.uniform(0.5, 3.0, 7), rng.uniform(5.0, 50.0, 7)


def test_energy(student):
    x, _, pairs, rest, k = net(1)
    expected = sum(
        0.5 * ke * (np.linalg.norm(x[i] - x[j]) - r) ** 2 for (i, j), r, ke in zip(pairs, rest, k, strict=True)
    )
    found = compare.number("energy", student.call("energy", x, pairs, rest, k))
    compare.at_most("the relative error of the energy", abs(found / expected - 1), 1e-12)


def test_spring_forces(student):
    """One spring first; then many that share points."""
    one = student.call(
        "spring_forces", np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[0, 1]]), np.array([1.5]), np.array([4.0])
    )
    compare.close("the force of one spring", one, [[2.0, 0.0], [-2.0, 0.0]], 1e-12)
    student.award(1 / 3)
    x, _, pairs, rest, k = net(2)
    expected = np.zeros_like(x)
    for (i, j), r, ke in zip(pairs, rest, k, strict=True):
        edge = x[i] - x[j]
        force = -ke * (1 - r / np.linalg.norm(edge)) * edge
        expected[i] += force
        expected[j] -= force
    compare.close("the forces of a net", student.call("spring_forces", x, pairs, rest, k), expected, 1e-11)


def test_damping_forces(student):
    """Two points first; then many dampers that share points."""
    x = np.array([[0.5, 0.0], [-0.5, 0.0]])
    turning = np.array([[0.0, 1.0], [0.0, -1.0]])
    pairs, c = np.array([[0, 1]]), np.array([2.0])
    closing = student.call("damping_forces", 4 * x, np.array([[-1.0, 0.5], [1.0, 0.5]]), pairs, c)
    compare.close("the damper of two points that approach each other", closing, [[4.0, 0.0], [-4.0, 0.0]], 1e-12)
    student.award(0.5)
    found = student.call("damping_forces", x, turning, pairs, c)
    compare.close("the damper of two points that turn", found, np.zeros((2, 2)), 1e-12)
    student.award(0.75)
    x, v, pairs, _, c = net(3)
    expected = np.zeros_like(x)
    for (i, j), ce in zip(pairs, c, strict=True):
        n = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j])
        force = -ce * ((v[i] - v[j]) @ n) * n
        expected[i] += force
        expected[j] -= force
    compare.close("the dampers of a net", student.call("damping_forces", x, v, pairs, c), expected, 1e-11)
