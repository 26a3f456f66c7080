"""Hidden items: orders of accuracy, conserved quantities, stability."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dsim.grading import compare
from dsim.grading.curves import Lines
from dsim.grading.student import ItemLost, kit_function


def end(student, force, x, v, h, steps):
    """(x, v) after some steps of their rk4, called here, so that `simulate` is not needed."""
    for n in range(steps):
        found = compare.pair("rk4", student.call("rk4", force, x, v, n * h, h), "(x, v)")
        x, v = (compare.array("rk4", part, x.shape) for part in found)
    return np.concatenate([x, v]).ravel()


def judged(student, force, start, truth):
    """Errors at t = 1 with ever smaller steps; better than Euler is worth a third."""
    x, v = (np.array([[value]]) for value in start)
    steps = np.array([8, 16])
    errors = [np.abs(end(student, force, x, v, 1.0 / count, count) - truth).max() for count in steps]
    if errors[0] > 2**1.5 * errors[1]:
        student.award(1 / 3)
    compare.order(1 / steps, errors, 4, 3.4, 5.2)


@given(angle=st.floats(0.5, 1.5), ratio=st.floats(3.0, 8.0))
def test_rk4_order(student, angle, ratio):
    def f(t, y):
        return [y[1], -ratio * np.sin(y[0])]

    truth = solve_ivp(f, (0, 1), [angle, 0.0], "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    judged(student, kit_function("pendulum", ratio=ratio), (angle, 0.0), truth)


@given(frequency=st.floats(1.5, 3.0), strength=st.floats(2.0, 5.0))
def test_rk4_time(student, frequency, strength):
    """x'' = -w^2 x + s cos t from rest: x = s (cos t - cos w t) / (w^2 - 1)."""
    w, s = frequency, strength
    truth = s / (w**2 - 1) * np.array([np.cos(1) - np.cos(w), -np.sin(1) + w * np.sin(w)])
    judged(student, kit_function("shaken", frequency=w, strength=s), (0.0, 0.0), truth)


@given(seed=st.integers(0, 2**31), method=st.sampled_from(["forward_euler", "symplectic_euler"]))
def test_simulate(student, seed, method):
    rng = np.random.default_rng(seed)
    x, v, h, steps = *rng.normal(size=(2, 3, 2)), 0.05, 6
    force = kit_function("shaken", frequency=2.0, strength=3.0)
    found = compare.pair("simulate", student.call("simulate", method, force, x, v, h, steps), "(X, V)")
    states = [compare.array(name, part, (steps + 1, 3, 2)) for name, part in zip("XV", found, strict=True)]
    compare.close("row 0 of X", states[0][0], x, 0.0)
    compare.close("row 0 of V", states[1][0], v, 0.0)
    if not all(np.any(np.diff(part, axis=0), axis=(1, 2)).all() for part in states):
        raise ItemLost("a state is the one before it: nothing moves there")
    student.award(0.5)
    for n in range(steps):  # by their own method: a mistake there costs its own item only
        step = compare.pair(method, student.call(method, force, states[0][n], states[1][n], n * h, h), "(x, v)")
        compare.close(f"X after step {n + 1}", states[0][n + 1], step[0], 1e-12)
        compare.close(f"V after step {n + 1}", states[1][n + 1], step[1], 1e-12)


def test_energy(student):
    """A circle of radius 1, two turns: the energy -1/2 may swing by 0.5 %, and not drift; forward Euler's halves.

    The planet has to go round: one that stays where it is keeps its energy as well.
    """
    x, v, h = np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]), 0.1
    found, turned = [], 0.0
    for n in range(126):
        step = student.call("symplectic_euler", kit_function("planet"), x, v, n * h, h)
        step, before = compare.pair("symplectic_euler", step, "(x, v)"), x[0]
        x, v = (compare.array("symplectic_euler", part, (1, 2)) for part in step)
        turned += np.arctan2(before[0] * x[0, 1] - before[1] * x[0, 0], before @ x[0])
        found.append(0.5 * (v**2).sum() - 1 / np.linalg.norm(x))
    change, t = np.array(found) + 0.5, h * np.arange(1, 127)
    drawn = (("yours", t, change), ("allowed", t, 0.02 + 0 * t), ("allowed", t, -0.02 + 0 * t))
    picture = Lines("Two turns of a planet, h = 0.1 s", "time (s)", "energy - its first value (J)", drawn)
    compare.at_most("the largest change of the energy", float(np.abs(change).max()), 2e-2, picture)
    if not abs(turned - 12.6) < 1:
        raise ItemLost(f"after 126 steps of 0.1 s it must have gone round twice; yours {turned / 6.2832:.1f} times")


@given(stiffness=st.floats(1.0, 1e4), mass=st.floats(0.1, 10.0))
def test_stable_step(student, stiffness, mass):
    h = compare.number("largest_stable_step", student.call("largest_stable_step", stiffness, mass))
    w = np.sqrt(stiffness / mass)
    compare.at_most("h w - 2", abs(h * w - 2), 1e-9)
