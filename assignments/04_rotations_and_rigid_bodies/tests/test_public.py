"""Public items: you have this file.  `student.call("f", ...)` calls your function f."""

import numpy as np
from scipy.spatial.transform import Rotation

from dsim.grading import compare
from dsim.grading.student import ItemLost, StudentError

BACK = np.array([1.0, -1.0, -1.0, -1.0])


def matrix(q):
    """The rotation of a quaternion w, x, y, z; scipy has w at the end."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix()


def unit(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def accepted(name, found, expected, tolerance, own):
    """What is expected; or what follows from your own earlier function, whose mistake is lost where it is asked for."""
    try:
        compare.close(name, found, expected, tolerance)
    except ItemLost as lost:
        try:
            compare.close(name, found, own(), tolerance)
        except (ItemLost, StudentError):
            raise lost from None


def sensible(student, function, *given, size):
    """What your function gives, if it is of about the size that it must have; a 0 is nothing to build on."""
    value = student.call(function, *given)
    found = compare.array(function, value, np.shape(value))
    if not 0.1 * size <= np.linalg.norm(found) <= 10 * size:
        raise ItemLost(f"{function} does not work yet")
    return found


def own_product(student, p, q):
    return sensible(student, "product", p, q, size=np.linalg.norm(p) * np.linalg.norm(q))


def test_product(student):
    """i j = k first; then: turning by q and then by p is turning by the product; and any lengths."""
    i, j, k = np.eye(4)[1:]
    found = compare.close("i (x) j", student.call("product", i, j), k, 1e-12)
    compare.close("j (x) i + i (x) j", student.call("product", j, i) + found, 0 * k, 1e-12)
    student.award(0.25)
    rng = np.random.default_rng(1)
    p, q, size = unit(rng), unit(rng), rng.uniform(0.5, 3.0)
    found = compare.array("product", student.call("product", p, q), (4,))
    compare.at_most("the change of the norm", abs(np.linalg.norm(found) - 1), 1e-12)
    compare.close("the rotation of p (x) q, beside that of q and then p", matrix(found), matrix(p) @ matrix(q), 1e-12)
    student.award(0.75)
    one = np.eye(4)[0]
    compare.close("(1, 0, 0, 0) (x) q", student.call("product", one, size * q), size * q, 1e-12)
    scaled = student.call("product", size * p, q)
    compare.close("p (x) q with a longer p", scaled, size * found, 1e-12)
    compare.close("q (x) conjugate(q)", student.call("product", q, q * BACK), one, 1e-12)


def test_rotate(student):
    rng = np.random.default_rng(2)
    q, u = unit(rng), rng.normal(size=3)

    def own():
        return own_product(student, own_product(student, q, np.append(0.0, u)), q * BACK)[1:]

    accepted("the turned vector", student.call("rotate", q, u), matrix(q) @ u, 1e-12, own)


def test_rates(student):
    """Against a difference: q after and before a short turn, on the body's side or on the world's."""
    rng = np.random.default_rng(3)
    q, omega, e = unit(rng), rng.normal(size=3), 1e-5

    def turned(t, inside):
        turn, start = Rotation.from_rotvec(t * omega), Rotation.from_quat(np.roll(q, -1))
        after = np.roll((start * turn if inside else turn * start).as_quat(), 1)
        return after if after @ q > 0 else -after

    for done, name, inside in ((0, "rate_body", True), (1, "rate_world", False)):
        expected = (turned(e, inside) - turned(-e, inside)) / (2 * e)
        pair = (q, np.append(0.0, omega)) if inside else (np.append(0.0, omega), q)
        found = student.call(name, q, omega)
        accepted(name, found, expected, 1e-8, lambda pair=pair: 0.5 * own_product(student, *pair))
        if not done:
            student.award(0.5)


def test_box_inertia(student):
    """Against the second moments of eight points (Gauss): exact for a box."""
    rng = np.random.default_rng(4)
    sides, mass = rng.uniform(0.2, 2.0, 3), rng.uniform(0.5, 3.0)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(8, 3)
    x = signs * sides / (2 * np.sqrt(3))
    expected = mass / 8 * sum(p @ p * np.eye(3) - np.outer(p, p) for p in x)
    compare.close("the inertia of a box", student.call("box_inertia", sides, mass), expected, 1e-12)


def test_body_torque(student):
    rng = np.random.default_rng(5)
    q, (x, point, force) = unit(rng), rng.normal(size=(3, 3))
    moment = np.cross(point - x, force)

    def own():
        return sensible(student, "rotate", q * BACK, moment, size=np.linalg.norm(moment))

    accepted("the torque", student.call("body_torque", q, x, point, force), matrix(q).T @ moment, 1e-12, own)
