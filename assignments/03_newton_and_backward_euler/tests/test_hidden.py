"""Hidden items: rates of convergence, orders of accuracy, stability; inputs are drawn from the instructor's secret."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dsim.grading import compare
from dsim.grading.curves import Lines
from dsim.grading.student import ItemLost, kit_function

seeds = st.integers(0, 2**31)


def pair(name, value):
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ItemLost(f"{name} must return a pair; got {type(value).__name__}")
    return value


def converged(value):
    z, word = pair("careful_newton", value)
    return z, bool(word)


@given(target=st.floats(2.0, 9.0), power=st.integers(2, 4))
def test_quadratic(student, target, power):
    """Their steps, one after the other: e_new / e^2 -> f''/(2 f') = (p - 1)/(2 root)."""
    root, z, errors = target ** (1 / power), np.array([1.3 * target ** (1 / power)]), []
    equation = kit_function("root", power=power, target=[target])
    for _ in range(4):
        z = compare.array("newton_step", student.call("newton_step", equation, z), (1,))
        errors.append(abs(float(z[0]) - root))
    count, expected = np.arange(1, 5), (power - 1) / (2 * root)
    newton = [errors[0]]
    for _ in range(3):
        newton.append(max(expected * newton[-1] ** 2, 1e-16))
    drawn = (("yours", count, np.maximum(errors, 1e-16)), ("Newton's", count, newton))
    picture = Lines("the digits double with every step", "step", "error", drawn, log="y")
    compare.at_most("the error after four steps", errors[-1], 1e-6, picture)
    student.award(0.5)
    ratios = [new / e**2 for e, new in pairwise(errors) if 1e-7 < e < 1e-2]
    if not ratios:  # as of a "step" that iterates on its own
        raise ItemLost("newton_step must take one step of Newton; yours goes on to the root")
    compare.at_most("|e_new/e^2 - f''/(2 f')|, relative", abs(ratios[-1] / expected - 1), 0.05, picture)


@given(start=st.floats(1.2, 4.0), scale=st.floats(0.8, 1.5))
def test_line_search(student, start, scale):
    """Newton's step on the valley is z -> -s^2 z^3: the length that is asked for can be computed."""
    z = np.array([start / scale])
    dz = -(scale**2) * z**3 - z

    def square(a):
        w = scale * (z + a * dz)
        return float(np.sum((scale * w / np.sqrt(1 + w**2)) ** 2))

    expected = 1.0
    while square(expected) > (1 - 2e-4 * expected) * square(0.0):
        expected /= 2
    found = compare.number("line_search", student.call("line_search", kit_function("valley", scale=scale), z, dz))
    compare.at_most("the step length's error", abs(found / expected - 1), 1e-12)
    student.award(0.5)
    good = student.call("line_search", kit_function("valley", scale=scale), z, -z)
    compare.at_most(
        "1 - the length of a step that leads to the zero at once", abs(compare.number("line_search", good) - 1), 0.0
    )


@given(start=st.floats(5.0, 200.0), sign=st.sampled_from([-1.0, 1.0]), zero=st.floats(0.5, 3.0))
def test_hard_starts(student, start, sign, zero):
    valley = kit_function("valley", scale=1.0, zero=zero)
    z, word = converged(student.call("careful_newton", valley, np.array([zero + sign * start])))
    compare.close("the zero of the valley", z, np.array([zero]), 1e-9)
    if not word:
        raise ItemLost("converged must be True at the zero")


def motion(rng):
    """A motion of the kit, its functions on this side, and a state."""
    ratio, friction = rng.uniform(2.0, 8.0), rng.uniform(0.1, 0.3)

    def tie(n):
        return np.roll(np.eye(n), -1, axis=1) - np.eye(n)

    def force(q, v):
        return -ratio * np.sin(q) - friction * v * np.abs(v) + tie(len(q)) @ q

    return (
        kit_function("pendulum", ratio=ratio, friction=friction),
        force,
        rng.uniform(0.7, 1.3, 3),
        rng.uniform(-1.0, 1.0, (2, 3)),
    )


@given(seed=seeds)
def test_step_matrix(student, seed):
    """Against differences of the true residual."""
    rng = np.random.default_rng(seed)
    given_motion, force, masses, (q, v0) = motion(rng)
    v, h = rng.normal(size=3), 0.4
    found = compare.array("step_matrix", student.call("step_matrix", given_motion, masses, q, v0, h, v), (3, 3))

    def residual(v):
        return masses * (v - v0) - h * force(q + h * v, v)

    measured = np.stack([(residual(v + e) - residual(v - e)) / 2e-5 for e in 1e-5 * np.eye(3)], axis=1)
    compare.close("the matrix of a step", found, measured, 1e-7)


@given(seed=seeds)
def test_backward_euler(student, seed):
    """The true residual of their answer; the step is so small that a wrong matrix, an item of its own, does too."""
    rng = np.random.default_rng(seed)
    given_motion, force, masses, (q, v) = motion(rng)
    h = 0.05
    found = pair("backward_euler", student.call("backward_euler", given_motion, masses, q, v, h))
    q1, v1 = (compare.array("backward_euler", part, (3,)) for part in found)
    compare.close("q1 - (q0 + h v1)", q1, q + h * v1, 1e-9)
    if (v1 == v).all():
        raise ItemLost("v1 is v0: the force has done nothing")
    student.award(0.25)
    left = np.abs(masses * (v1 - v) - h * force(q1, v1)).max()
    if left < 1e-2:
        student.award(0.5)
    compare.at_most("the residual of the answer", float(left), 1e-8)


@given(stiffness=st.floats(5e3, 1e6), mass=st.floats(0.7, 1.3))
def test_order(student, stiffness, mass):
    """A stiff spring, with any step; then a pendulum with ever smaller ones."""
    h, w2 = 0.1, stiffness / mass
    spring = kit_function("spring", stiffness=stiffness, damping=0.0)
    q, v = states(student, spring, np.array([mass]), (np.array([1.0]), np.array([0.0])), h, 5)
    q, v = np.clip(q, -1e100, 1e100), np.clip(v, -1e100, 1e100)  # what grows must not overflow here
    energy = 0.5 * mass * v[:, 0] ** 2 + 0.5 * stiffness * q[:, 0] ** 2
    energy /= energy[0]
    expected, after = energy[:-1] / (1 + h**2 * w2), 1 + np.arange(5)
    drawn = (("yours", after, energy[1:]), ("from yours before, by the formula", after, expected))
    picture = Lines("a stiff spring", "step", "energy, of the first", drawn, log="y")
    wrong = float(np.abs(energy[1:] - expected).max())
    compare.at_most("the error of the energy after a step on a spring", wrong, 1e-6, picture)
    student.award(0.5)

    def flow(t, y):
        return [y[1], -4.0 * np.sin(y[0]) - 0.3 * y[1] * abs(y[1])]

    truth = solve_ivp(flow, (0, 1), [1.0, 0.0], "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    pendulum, errors = kit_function("pendulum", ratio=4.0, friction=0.3), []
    for steps in (20, 40):
        q, v = states(student, pendulum, np.ones(1), (np.array([1.0]), np.array([0.0])), 1.0 / steps, steps)
        errors.append(np.abs(np.array([q[-1, 0], v[-1, 0]]) - truth).max())
    compare.order([1 / 20, 1 / 40], errors, 1, 0.8, 1.2)


def states(student, given_motion, masses, start, h, steps):
    found = pair("simulate", student.call("simulate", given_motion, masses, *start, h, steps))
    q, v = (compare.array(name, part, (steps + 1, len(masses))) for name, part in zip("QV", found, strict=True))
    compare.close("row 0", np.stack([q[0], v[0]]), np.stack(start), 0.0)
    return q, v


@given(seed=seeds)
def test_two_step(student, seed):
    rng = np.random.default_rng(seed)
    given_motion, force, masses, (q0, v) = motion(rng)
    h = 0.05
    before = q0 - h * v
    found = compare.array("two_step", student.call("two_step", given_motion, masses, before, q0, h), (3,))
    left = masses * (found - 2 * q0 + before) - h**2 * force(found, (found - q0) / h)
    compare.at_most("the residual of the two-step formula", float(np.abs(left).max()), 1e-8)
