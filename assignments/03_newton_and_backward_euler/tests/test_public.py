"""Public items; `dsim check-submission` runs them.  `student.call("f", ...)` calls your function f."""

import numpy as np

from dsim.grading import compare
from dsim.grading.student import ItemLost, kit_function


def answer(value):
    """Your (z, converged)."""
    if (
        not isinstance(value, tuple | list)
        or len(value) != 2
        or not isinstance(value[1], bool | np.bool_ | int | np.ndarray)
    ):
        got = compare.described(value)
        raise ItemLost(f"newton must return the pair (z, converged), converged True or False; got {got}")
    return value[0], bool(value[1])


def test_newton_step(student):
    found = student.call("newton_step", kit_function("root", power=3, target=[8.0, 27.0]), np.array([3.0, 2.0]))
    compare.close("one step for z^3 = (8, 27) from (3, 2)", found, [3 - 19 / 27, 2 + 19 / 12], 1e-12)
    student.award(0.5)
    z = np.array([0.5, 0.7])
    jacobian = np.array([[1.0, 3 * 0.8 * 0.49], [-3 * 0.8 * 0.25, 1.0]])
    residual = np.array([0.5 + 0.8 * 0.343 - 1, 0.7 - 0.8 * 0.125])
    found = student.call("newton_step", kit_function("coupled", strength=0.8), z)
    compare.close(
        "one step with a Jacobian that is not symmetric", found, z - np.linalg.solve(jacobian, residual), 1e-12
    )


def test_newton(student):
    z, converged = answer(
        student.call("newton", kit_function("root", power=2, target=[2.0, 9.0]), np.array([1.0, 5.0]))
    )
    compare.close("the roots of 2 and 9", z, [np.sqrt(2), 3.0], 1e-12)
    if not converged:
        raise ItemLost("converged must be True where the last correction was small")
    student.award(0.5)
    _, converged = answer(student.call("newton", kit_function("valley", scale=1.0), np.array([2.0])))
    if converged:
        raise ItemLost("converged must be False where Newton runs away")


def test_step_residual(student):
    rng = np.random.default_rng(3)
    q, v0, v = rng.normal(size=(3, 2))
    masses, h = np.array([0.5, 2.0]), 0.3
    found = student.call("step_residual", kit_function("spring", stiffness=5.0, damping=0.7), masses, q, v0, h, v)
    force = -5.0 * (q + h * v) - 0.7 * v
    compare.close("the residual of a step", found, masses * (v - v0) - h * force, 1e-12)
