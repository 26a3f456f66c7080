"""Hidden items: independent truth, orders of accuracy, conserved quantities.

Attitudes are compared as rotations, for q and -q are the same.  A step is right if it does what is asked with true
functions, or with their own, so that a mistake is lost once.
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from dsim.geometry.inertia import MassProperties
from dsim.grading import compare
from dsim.grading.curves import Lines
from dsim.grading.student import ItemLost, StudentError

seeds = st.integers(0, 2**31)
BACK = np.array([1.0, -1.0, -1.0, -1.0])


def turn(q):
    """The rotation of a quaternion w, x, y, z, or of rows of them."""
    return Rotation.from_quat(np.roll(q, -1, axis=-1))


def unit(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def inertia_of(rng):
    """Of a box that stands askew."""
    squares = rng.uniform(0.5, 3.0, 3)
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    return R @ np.diag(squares.sum() - squares) @ R.T


def parts(name, value, *shapes):
    if not isinstance(value, tuple | list) or len(value) != len(shapes):
        raise ItemLost(f"{name} must return {len(shapes)} values; got {type(value).__name__}")
    return [
        compare.array(f"value {i + 1} of {name}", part, shape)
        for i, (part, shape) in enumerate(zip(value, shapes, strict=True))
    ]


def attitude(name, q, expected):
    """As rotations, of quaternions that have the norm 1."""
    compare.at_most(f"the norm of {name} less 1", float(np.abs(np.linalg.norm(q, axis=-1) - 1).max()), 1e-9)
    angle = (turn(q).inv() * expected).magnitude()
    compare.at_most(f"the angle (rad) from {name} to the attitude it should be", float(np.max(angle)), 1e-7)


def same(q, own):
    """q is what follows from their own functions, up to the sign."""
    if not min(np.abs(q - own).max(), np.abs(q + own).max()) <= 1e-9:
        raise ItemLost("not this either")


def sensible(student, function, *given, size=0.0):
    """What their function gives, if it is of about the size that it must have: on a 0 nothing can be built."""
    value = student.call(function, *given)
    found = compare.array(function, value, np.shape(value))
    norm = np.linalg.norm(found)
    if not (0.1 * size <= norm <= 10 * size if size else norm > 1e-6):
        raise ItemLost(f"{function} does not work yet")
    return found


def own_product(student, p, q):
    return sensible(student, "product", p, q, size=np.linalg.norm(p) * np.linalg.norm(q))


def either(check, own):
    """The truth; or, where it is lost, what follows from their own earlier functions."""
    try:
        check()
    except ItemLost as lost:
        try:
            own()
        except (ItemLost, StudentError):
            raise lost from None


@given(seed=seeds)
def test_exponential(student, seed):
    """Ordinary turns; then those near pi, near a full turn and beyond; tiny ones to all their digits; and none."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)

    def found(*angles):
        r = np.outer(angles, axis)
        q = np.array([compare.array("exponential", student.call("exponential", row), (4,)) for row in r])
        attitude("exponential", q, Rotation.from_rotvec(r))
        return q

    found(rng.uniform(0.5, 2.5))
    student.award(0.25)
    found(np.pi - 1e-7, np.pi + rng.uniform(0.1, 2.0), 2 * np.pi - 1e-3, 2 * np.pi + rng.uniform(0.5, 9.0))
    student.award(0.5)
    tiny = np.array([3e-3, 10 ** rng.uniform(-9, -4)])
    q = found(*tiny)
    axes = q[:, 1:] * np.sign(q[:, :1]) / np.sin(tiny / 2)[:, None]
    compare.close("the axis of a tiny turn", axes, [axis, axis], 1e-9)
    student.award(0.75)
    q = compare.array("exponential of (0, 0, 0)", student.call("exponential", np.zeros(3)), (4,))
    attitude("exponential of (0, 0, 0)", q, Rotation.identity())


@given(seed=seeds)
def test_compose(student, seed):
    """Clouds of points: all of them at once, and part by part.  And against dsim's own bodies."""
    rng = np.random.default_rng(seed)
    m, x = rng.uniform(0.5, 2.0, (3, 5)), rng.normal(size=(3, 5, 3)) + rng.normal(size=(3, 1, 3)) + 1.0
    masses, centres = m.sum(axis=1), np.einsum("kn,kni->ki", m, x) / m.sum(axis=1)[:, None]

    def cloud(m, x):
        return sum(mass * (p @ p * np.eye(3) - np.outer(p, p)) for mass, p in zip(m, x, strict=True))

    inertias = np.array([cloud(*one) for one in zip(m, x - centres[:, None], strict=True)])
    centre = m.ravel() @ x.reshape(-1, 3) / m.sum()
    expected = cloud(m.ravel(), x.reshape(-1, 3) - centre)
    whole = sum((MassProperties(*one) for one in zip(masses[1:], centres[1:], inertias[1:], strict=True)),
                MassProperties(masses[0], centres[0], inertias[0]))  # fmt: skip
    assert np.allclose(whole.inertia, expected, rtol=1e-12), "two truths that differ"
    mass, place, inertia = parts("compose", student.call("compose", masses, centres, inertias), (), (3,), (3, 3))
    compare.close("the mass", mass, m.sum(), 1e-12)
    compare.close("the centre of mass", place, centre, 1e-11)
    student.award(0.5)
    compare.close("the inertia", inertia, expected, 1e-11)


@given(seed=seeds)
def test_angular_acceleration(student, seed):
    """The momentum in the world, R I omega, before and after: its rate is the torque."""
    rng = np.random.default_rng(seed)
    inertia, omega, torque = inertia_of(rng), rng.normal(size=3), rng.normal(size=3)
    still = compare.array(
        "angular_acceleration", student.call("angular_acceleration", inertia, 0 * omega, torque), (3,)
    )
    compare.close("I d(omega)/dt of a body at rest", inertia @ still, torque, 1e-11)
    student.award(0.5)
    found = student.call("angular_acceleration", inertia, omega, torque)
    alpha, e = compare.array("angular_acceleration", found, (3,)), 1e-5

    def momentum(t):
        return Rotation.from_rotvec(t * omega).as_matrix() @ inertia @ (omega + t * alpha)

    rate = (momentum(e) - momentum(-e)) / (2 * e)
    compare.close("the rate of the angular momentum in the world, less the torque", rate - torque, 0 * torque, 1e-7)


def situation(seed):
    """A body with three forces, and a step in which it turns by a good radian."""
    rng = np.random.default_rng(seed)
    mass, inertia = rng.uniform(0.5, 3.0), inertia_of(rng)
    state = (rng.normal(size=3), unit(rng), rng.normal(size=3), rng.uniform(1.0, 3.0, 3) * rng.choice([-1, 1], 3))
    return mass, inertia, state, rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), 0.3


def velocities(mass, inertia, state, points, forces, h):
    """The new velocities, and the new position; scipy's matrices for the turn."""
    x, q, v, omega = state
    torque = turn(q).inv().apply(np.cross(points - x, forces).sum(axis=0))
    v = v + h * forces.sum(axis=0) / mass
    omega = omega + h * np.linalg.solve(inertia, torque - np.cross(omega, inertia @ omega))
    return x + h * v, v, omega


def own_spin(student, inertia, state, points, forces, h):
    x, q, _, omega = state
    torques = [sensible(student, "body_torque", q, x, p, f) for p, f in zip(points, forces, strict=True)]
    return omega + h * sensible(student, "angular_acceleration", inertia, omega, np.sum(torques, axis=0))


def state_after(student, name, given):
    return parts(name, student.call(name, *given), (3,), (4,), (3,), (3,))


def velocities_right(student, found, given):
    """x and v are worth a quarter, omega one more."""
    x, _, v, omega = found
    true_x, true_v, true_omega = velocities(*given)
    compare.close("v", v, true_v, 1e-11)
    compare.close("x", x, true_x, 1e-11)
    student.award(0.25)
    either(lambda: compare.close("omega", omega, true_omega, 1e-11),
           lambda: compare.close("omega", omega, own_spin(student, *given[1:]), 1e-11))  # fmt: skip
    student.award(0.5)


def as_in_the_loop(student, found, given):
    """What was wrong in their loop was lost there; but a loop that leaves everything as it was is none."""
    loop, before = state_after(student, "loop_step", given), given[2]
    for i, name in ((0, "x"), (2, "v"), (3, "omega")):
        compare.close(name, found[i], loop[i], 1e-11)
        if np.abs(loop[i] - before[i]).max() < 1e-4:
            raise ItemLost("nothing moves")
    student.award(0.5)


@given(seed=seeds)
def test_loop_step(student, seed):
    given_ = situation(seed)
    q0, h = given_[2][1], given_[-1]
    found = state_after(student, "loop_step", given_)
    velocities_right(student, found, given_)
    _, q, _, omega = found

    def check():  # q + h/2 q (x) omega has the direction of a turn by 2 atan(h |omega| / 2)
        size = np.linalg.norm(omega)
        attitude("q", q, turn(q0) * Rotation.from_rotvec(2 * np.arctan(h * size / 2) / size * omega))

    def own():
        new = q0 + h * sensible(student, "rate_body", q0, omega)
        same(q, new / np.linalg.norm(new))

    either(check, own)


@given(seed=seeds)
def test_exponential_step(student, seed):
    given_ = situation(seed)
    q0, h = given_[2][1], given_[-1]
    found = state_after(student, "exponential_step", given_)
    either(lambda: velocities_right(student, found, given_), lambda: as_in_the_loop(student, found, given_))
    _, q, _, omega = found

    def own():
        r = sensible(student, "exponential", h * omega, size=1.0)
        if np.abs(r[1:]).max() < 1e-3:
            raise ItemLost("no turn")
        same(q, own_product(student, q0, r))

    either(lambda: attitude("q", q, turn(q0) * Rotation.from_rotvec(h * omega)), own)


def trajectory(student, inertia, q, omega, h, steps):
    Q, W = parts("free_body", student.call("free_body", inertia, q, omega, h, steps), (steps + 1, 4), (steps + 1, 3))
    compare.close("row 0 of W", W[0], omega, 1e-13)
    attitude("row 0 of Q", Q[0], turn(q))
    return Q, W


def truth(moments, q, omega):
    """Attitude and spin after half a second, in the frame of the principal axes."""
    a, b, c = ((moments[1] - moments[2]) / moments[0], (moments[2] - moments[0]) / moments[1],
               (moments[0] - moments[1]) / moments[2])  # fmt: skip

    def flow(t, y):
        w, x, y_, z, p, q_, r = y
        return [(-x * p - y_ * q_ - z * r) / 2, (w * p + y_ * r - z * q_) / 2, (w * q_ + z * p - x * r) / 2,
                (w * r + x * q_ - y_ * p) / 2, a * q_ * r, b * p * r, c * p * q_]  # fmt: skip

    y = solve_ivp(flow, (0, 0.5), [*q, *omega], "DOP853", rtol=1e-9, atol=1e-9).y[:, -1]
    return turn(y[:4]), y[4:]


@given(seed=seeds)
def test_free_body(student, seed):
    """Observed order of accuracy.  The error is of angle and spin together: of one alone it may vanish by chance."""
    rng = np.random.default_rng(seed)
    squares = np.array([0.4, 1.2, 2.9]) * rng.uniform(0.9, 1.1, 3)
    moments, q, omega = squares.sum() - squares, unit(rng), rng.uniform(1.2, 2.0, 3) * rng.choice([-1, 1], 3)
    end, spin = truth(moments, q, omega)

    def check():
        steps, errors = np.array([5, 15]), []
        for count in steps:
            Q, W = trajectory(student, np.diag(moments), q, omega, 0.5 / count, int(count))
            compare.at_most("|Q| - 1", float(np.abs(np.linalg.norm(Q, axis=1) - 1).max()), 1e-9)
            angle = (turn(Q[-1]).inv() * end).magnitude()
            errors.append(np.hypot(angle, np.linalg.norm(W[-1] - spin)))
        if errors[0] < 1.0 and errors[0] > 2 * errors[1]:  # the first order is worth a half
            student.award(0.5)
        if errors[1] > 1e-7:  # below, the truth's own error would be measured
            compare.order(0.5 / steps, errors, 2, 1.8, 6.0)

    either(check, lambda: own_steps(student, np.diag(moments), q, omega))


def own_steps(student, inertia, q, omega):
    """Three steps as the handout says, by their own rotate, product and exponential."""
    h, steps = 0.1, 3
    Q, W = parts("free_body", student.call("free_body", inertia, q, omega, h, steps), (steps + 1, 4), (steps + 1, 3))
    size = np.linalg.norm(inertia @ omega)
    momentum = sensible(student, "rotate", q, inertia @ omega, size=size)

    def turned(q, spin):
        return own_product(student, q, sensible(student, "exponential", spin, size=1.0))

    def spin(q):
        return np.linalg.solve(inertia, sensible(student, "rotate", q * BACK, momentum, size=size))

    for n in range(steps):
        new = turned(q, h * spin(turned(q, h / 2 * omega)))
        if np.abs(new - q).max() < 1e-4:
            raise ItemLost("nothing turns")
        q, omega = new, spin(new)
        same(Q[n + 1], q)
        compare.close("W", W[n + 1], omega, 1e-9)


@given(seed=seeds)
def test_conserved(student, seed):
    """Momentum in the world, norms, the energy (it may swing a little), and that Q turns as W says."""
    rng = np.random.default_rng(seed)
    inertia, q, omega, h, steps = inertia_of(rng), unit(rng), rng.normal(size=3), 0.05, 10
    omega *= 2.0 / np.linalg.norm(omega)
    Q, W = trajectory(student, inertia, q, omega, h, steps)
    compare.at_most("|Q| - 1", float(np.abs(np.linalg.norm(Q, axis=1) - 1).max()), 1e-11)
    turns = (turn(Q[:-1]).inv() * turn(Q[1:])).magnitude() / (h * np.linalg.norm(W[:-1], axis=1))
    compare.at_most("the angle from row to row by h |W|, less 1", float(np.abs(turns - 1).max()), 0.2)
    student.award(0.25)
    momentum, energy = turn(Q).apply(W @ inertia), 0.5 * np.einsum("ni,ij,nj->n", W, inertia, W)
    moved = np.linalg.norm(momentum - momentum[0], axis=1)[1:] / np.linalg.norm(momentum[0])
    swing, t = np.abs(energy[1:] / energy[0] - 1), h * np.arange(1, steps + 1)
    drawn = (("momentum in the world", t, np.maximum(moved, 1e-17)), ("allowed", t, 1e-11 + 0 * t),
             ("energy", t, np.maximum(swing, 1e-17)), ("allowed", t, 5e-2 + 0 * t))  # fmt: skip
    picture = Lines("A free body: changes since the start", "time (s)", "change, relative", drawn, log="y")
    compare.at_most("the change of the energy, relative", float(swing.max()), 5e-2, picture)
    student.award(0.5)
    compare.at_most("the change of the angular momentum, relative", float(moved.max()), 1e-11, picture)
