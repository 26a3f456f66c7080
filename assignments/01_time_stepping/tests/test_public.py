"""Public items; `dsim check-submission` runs them.  `student.call("f", ...)` calls your function f."""

import numpy as np

from dsim.grading import compare
from dsim.grading.student import kit_function


def pair(name, value, shape):
    """Your (x, v) as two arrays."""
    parts = compare.pair(name, value, "(x, v)")
    return [compare.array(f"{part} of {name}", found, shape) for part, found in zip("xv", parts, strict=True)]


def test_forces(student):
    rng = np.random.default_rng(1)
    v, mass = rng.normal(size=(5, 3)), rng.uniform(0.5, 2.0, 5)
    gravity, wind = np.array([0.0, 0.0, -9.81]), np.array([1.0, -2.0, 0.5])
    zero = np.zeros(3)
    compare.close("the weight", student.call("forces", v, mass, gravity, 0.0, wind), mass[:, None] * gravity, 1e-12)
    student.award(0.5)
    found = student.call("forces", v, mass, zero, 0.3, wind)
    compare.close("drag", found, -0.3 * (v - wind), 1e-12)


def one_step(student, method, expected):
    """expected(x, v, a, h): (x, v) after the step.  A fall looks at v alone; a shaken spring at x and t."""
    rng = np.random.default_rng(2)
    (x, v), t, h = rng.normal(size=(2, 4, 2)), 0.4, 0.1
    x1, v1 = expected(x, v, -0.7 * v - np.array([0.0, 9.81]), h)
    found = pair(method, student.call(method, kit_function("falling", gravity=9.81, drag=0.7), x, v, 0.0, h), x.shape)
    compare.close(f"v of {method}", found[1], v1, 1e-12)
    student.award(0.5)
    compare.close(f"x of {method}", found[0], x1, 1e-12)
    x1, v1 = expected(x, v, -4.0 * x + 3.0 * np.cos(t), h)
    shaken = kit_function("shaken", frequency=2.0, strength=3.0)
    found = pair(method, student.call(method, shaken, x, v, t, h), x.shape)
    compare.close(f"v of {method} on a shaken spring", found[1], v1, 1e-12)
    compare.close(f"x of {method} on a shaken spring", found[0], x1, 1e-12)


def test_forward_euler(student):
    one_step(student, "forward_euler", lambda x, v, a, h: (x + h * v, v + h * a))


def test_symplectic_euler(student):
    one_step(student, "symplectic_euler", lambda x, v, a, h: (x + h * (v + h * a), v + h * a))
