"""Rotations against SciPy's, on random and on extreme turns; the notes' matrix; maps and their derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dsim.arrays import rotation

ROUND_OFF = 2e-14

directions = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda u: np.linalg.norm(u) > 1e-3)
angles = st.one_of(
    st.floats(0, np.pi),
    st.sampled_from([0.0, 1e-300, 1e-160, 1e-9, 1e-4, 0.0099999, 0.0100001]),
    st.floats(1e-12, 1e-6).map(lambda gap: np.pi - gap),
)
vectors = st.builds(lambda u, angle: angle * u / np.linalg.norm(u), directions, angles)
factors = st.sampled_from([1e-150, 1e-3, -1.0, 7.0, 1e150])


def turned(r: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(r)


def apart(q: np.ndarray, other: Rotation) -> float:
    """Distance of matrices: q and -q are the same."""
    return float(np.abs(rotation.to_matrix(q) - other.as_matrix()).max())


@given(vectors)
def test_exponential_and_logarithm_are_scipys(r):
    q = rotation.exponential(r)
    assert apart(q, turned(r)) <= ROUND_OFF and abs(np.linalg.norm(q) - 1) <= ROUND_OFF
    assert np.abs(rotation.logarithm(q) - r).max() <= ROUND_OFF * max(1.0, np.linalg.norm(r))
    tiny = np.linalg.norm(r)
    if 0 < tiny < 1e-6:  # relative, too: no small angle is lost
        assert np.abs(rotation.logarithm(q) - r).max() <= ROUND_OFF * tiny


def test_the_quaternion_0_has_no_logarithm():
    with pytest.raises(ValueError, match=r"q must be quaternions other than 0.* at index 1"):
        rotation.logarithm(np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]))
    with pytest.raises(ValueError, match="q must be quaternions other than 0"):
        rotation.logarithm(np.zeros(4))


@given(vectors, vectors)
def test_products_compose_and_conjugates_invert(a, b):
    p, q = rotation.exponential(a), rotation.exponential(b)
    assert apart(rotation.product(p, q), turned(a) * turned(b)) <= ROUND_OFF
    assert apart(rotation.conjugate(p), turned(a).inv()) <= ROUND_OFF
    assert np.allclose(rotation.rotate(p, b), turned(a).apply(b), rtol=0, atol=5 * ROUND_OFF)


@given(vectors, factors)
def test_a_quaternion_of_any_norm_is_an_attitude(r, factor):
    q = rotation.as_unit("q", factor * rotation.exponential(r))
    assert apart(q, turned(r)) <= ROUND_OFF
    assert np.abs(np.abs(rotation.logarithm(-q)) - np.abs(rotation.logarithm(q))).max() <= 2e-6  # at a half turn, +-


@given(vectors)
def test_matrices_give_their_quaternion_back(r):
    R = turned(r).as_matrix()
    q = rotation.from_matrix(R)
    assert np.abs(rotation.to_matrix(q) - R).max() <= ROUND_OFF and q[0] >= 0


@pytest.mark.parametrize(
    "bad, words", [([0, 0, 0, 0], "other than 0"), ([1, 0, 0], "shape"), ([1, np.nan, 0, 0], "finite")]
)
def test_what_is_no_attitude_is_refused(bad, words):
    with pytest.raises(ValueError, match=f"q must.*{words}"):
        rotation.as_unit("q", bad)


def test_many_at_once_are_the_same_as_one_by_one():
    r = np.random.default_rng(0).normal(size=(4, 5, 3))
    q, u = rotation.exponential(r), np.random.default_rng(1).normal(size=(4, 5, 3))
    for place in np.ndindex(4, 5):
        assert np.array_equal(rotation.exponential(r[place]), q[place])
        assert np.array_equal(rotation.rotate(q[place], u[place]), rotation.rotate(q, u)[place])


def test_rates_are_products_with_the_angular_velocity():
    q, w = np.random.default_rng(2).normal(size=(2, 7, 4))
    w[:, 0] = 0
    assert np.allclose(np.einsum("bij,bj->bi", rotation.body_rates(q), w[:, 1:]), rotation.product(q, w))
    assert np.allclose(np.einsum("bij,bj->bi", rotation.world_rates(q), w[:, 1:]), rotation.product(w, q))


def as_printed(q: np.ndarray) -> np.ndarray:
    """The matrix of the notes with its first entry as printed there, +q_x."""
    G = rotation.world_rates(q)
    G[..., 0, 0] *= -1
    return G


def test_only_the_corrected_matrix_of_the_notes_keeps_the_norm():
    """d|q|^2/dt = q . G omega, which must vanish for every omega; and the turn must be the one that was asked for."""
    rng = np.random.default_rng(3)
    q = rotation.normalised(rng.normal(size=(50, 4)))
    assert np.abs(np.einsum("bi,bij->bj", q, rotation.world_rates(q))).max() <= 1e-15
    assert np.abs(np.einsum("bi,bij->bj", q, as_printed(q))).max() > 0.5
    h, omega, start = 1e-4, np.array([0.4, -0.3, 0.8]), q[0]
    for matrix, good in ((rotation.world_rates, True), (as_printed, False)):
        state = start
        for _ in range(10_000):
            middle = state + h / 4 * matrix(state) @ omega
            state = state + h / 2 * matrix(middle) @ omega
        truth = rotation.product(rotation.exponential(omega), start)
        assert (abs(np.linalg.norm(state) - 1) <= 1e-8) == good
        assert (np.abs(state - truth).max() <= 1e-8) == good


def test_the_matrix_equation_is_the_same_motion():
    """Rdot = [omega]x R and qdot = 1/2 G omega, both by the midpoint rule: R, q agree to the order of the rule."""
    omega = lambda t: np.array([np.cos(t), 0.5, np.sin(2 * t)])  # noqa: E731
    gaps = []
    for steps in (100, 200):
        h, R, q = 1 / steps, np.eye(3), np.array([1.0, 0, 0, 0])
        for n in range(steps):
            w = omega((n + 0.5) * h)
            R = R + h * rotation.skew(w) @ (R + h / 2 * rotation.skew(w) @ R)
            q = q + h / 2 * rotation.world_rates(q + h / 4 * rotation.world_rates(q) @ w) @ w
        gaps.append(np.abs(R - rotation.to_matrix(rotation.normalised(q))).max())
    assert gaps[1] < gaps[0] / 3.5 < 1e-4


@pytest.mark.parametrize("name", ["exponential", "cayley"])
@given(r=vectors)
def test_tangents_are_the_derivatives_of_their_maps(name, r):
    turn, T = getattr(rotation, name), getattr(rotation, f"{name}_tangent")(r)
    for direction in np.eye(3):
        ahead, behind = (turn(r + s * direction) for s in (1e-5, -1e-5))
        moved = rotation.logarithm(rotation.product(rotation.conjugate(behind), ahead)) / 2e-5
        assert np.abs(moved - T @ direction).max() <= 1e-9


@given(vectors.filter(lambda r: np.linalg.norm(r) < 3))
def test_normalising_a_step_is_the_cayley_map(r):
    q = rotation.exponential(np.array([0.3, -0.4, 0.5]))
    stepped = rotation.normalised(q + 0.5 * rotation.body_rates(q) @ r)
    assert np.abs(stepped - rotation.product(q, rotation.cayley(r))).max() <= ROUND_OFF
    assert np.allclose(rotation.inverse_cayley(rotation.cayley(r)), r, rtol=1e-13, atol=1e-15)


def test_wrong_derivatives_are_noticed():
    """Mutation: the tangent of the inverse turn, [r]x with the other sign."""
    r = np.array([0.3, -0.5, 0.7])
    assert np.abs(rotation.exponential_tangent(-r) - rotation.exponential_tangent(r)).max() > 0.1
