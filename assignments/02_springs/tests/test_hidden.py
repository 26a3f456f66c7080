"""Hidden items: derivatives against differences of dsim's own springs, whatever way they are written."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsim import System
from dsim.effects import SpringDamping, Springs
from dsim.grading import compare
from dsim.grading.student import ItemLost
from dsim.planning import highest_frequency

PAIRS = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 4], [4, 0]])
seeds = st.integers(0, 2**31)


def net(seed, dimension):
    rng = np.random.default_rng(seed)
    x, v = rng.normal(size=(2, 5, dimension))
    length = np.linalg.norm(x[PAIRS[:, 0]] - x[PAIRS[:, 1]], axis=1)
    rest = length * rng.uniform(0.5, 2.0, len(PAIRS))  # some stretched, some pressed
    return x, v, rest, rng.uniform(5.0, 50.0, len(PAIRS)), rng.uniform(0.1, 2.0, len(PAIRS))


def matrix(name, value, shape):
    return compare.array(name, value, shape)


def differences(force, z):
    """(n, m): central differences of a force that is smooth."""
    h = 1e-5
    return np.stack([(force(z + h * e) - force(z - h * e)) / (2 * h) for e in np.eye(len(z))], axis=1)


@given(seed=seeds, dimension=st.sampled_from([2, 3]))
def test_coincident(student, seed, dimension):
    """A spring without length changes nothing: their own forces with it and without it, whatever those are.

    One with a length does: who gives no forces at all has not answered.
    """
    x, v, rest, k, c = net(seed, dimension)
    x[1] = x[0]
    for name, state, constants in (("spring_forces", (x,), (rest, k)), ("damping_forces", (x, v), (c,))):
        found = compare.array(name, student.call(name, *state, PAIRS, *constants), x.shape)
        others = student.call(name, *state, PAIRS[1:], *(values[1:] for values in constants))
        compare.close(f"{name} with a spring that has no length, less those without it", found - others, 0 * x, 1e-10)
        fewer = student.call(name, *state, PAIRS[1:-1], *(values[1:-1] for values in constants))
        if not np.abs(compare.array(name, fewer, x.shape) - others).max() > 1e-10:
            raise ItemLost(f"{name} gives the same with a spring fewer, one that has a length")


@given(seed=seeds, dimension=st.sampled_from([2, 3]))
def test_stiffness_blocks(student, seed, dimension):
    x, _, rest, k, _ = net(seed, dimension)
    found = matrix("stiffness_blocks", student.call("stiffness_blocks", x, PAIRS, rest, k), (7, dimension, dimension))
    _, n = lengths(x)
    along = np.einsum("ed,edf,ef->e", n, found, n)
    compare.close("the stiffness along each spring", along, -k, 1e-8)
    student.award(1 / 3)
    for e, (i, j) in enumerate(PAIRS):
        pair = System(np.ones(2), [Springs([(0, 1)], rest[e], k[e])], dimension)
        ends = np.concatenate([x[i], x[j]])
        measured = differences(lambda z, pair=pair: pair.force(0.0, z, 0 * z), ends)[:dimension, :dimension]
        compare.close("the derivative of one spring's force", found[e], measured, 1e-6)


def lengths(x):
    edge = x[PAIRS[:, 0]] - x[PAIRS[:, 1]]
    length = np.linalg.norm(edge, axis=1)
    return length, edge / length[:, None]


@given(seed=seeds, dimension=st.sampled_from([2, 3]))
def test_damping_blocks(student, seed, dimension):
    x, v, _, _, c = net(seed, dimension)
    found = matrix("damping_blocks", student.call("damping_blocks", x, PAIRS, c), (7, dimension, dimension))
    for e, (i, j) in enumerate(PAIRS):
        pair = System(np.ones(2), [SpringDamping([(0, 1)], c[e])], dimension)
        ends, w = np.concatenate([x[i], x[j]]), np.concatenate([v[i], v[j]])
        measured = differences(lambda z, pair=pair, ends=ends: pair.force(0.0, ends, z), w)[:dimension, :dimension]
        compare.close("the derivative of one damper's force", found[e], measured, 1e-6)


@given(seed=seeds)
def test_assemble(student, seed):
    """Blocks of any kind, also unsymmetric ones: the matrix says what `sum of block times difference` says."""
    rng = np.random.default_rng(seed)
    blocks, u = rng.normal(size=(7, 2, 2)), rng.normal(size=(6, 2))
    found = matrix("assemble", student.call("assemble", blocks, PAIRS, 6), (12, 12))
    expected = np.zeros((6, 2))
    for block, (i, j) in zip(blocks, PAIRS, strict=True):
        expected[i] += block @ (u[i] - u[j])
        expected[j] -= block @ (u[i] - u[j])
    compare.close("the assembled matrix times a vector", found @ u.ravel(), expected.ravel(), 1e-11)


@given(seed=seeds, dimension=st.sampled_from([2, 3]))
def test_force_by_parameters(student, seed, dimension):
    x, v, rest, k, _ = net(seed, dimension)
    found = student.call("force_by_parameters", x, PAIRS, rest, k)
    found = compare.pair("force_by_parameters", found, "(F_k, F_rest)")

    def force(theta):
        springs = Springs(PAIRS, theta[:7], theta[7:])
        return System(np.ones(5), [springs], dimension).force(0.0, x.ravel(), v.ravel())

    measured = differences(force, np.concatenate([rest, k]))
    compare.close("the derivative by stiffness", found[0], measured[:, 7:], 1e-7)
    student.award(0.5)
    compare.close("the derivative by rest length", found[1], measured[:, :7], 1e-7)


@given(seed=seeds)
def test_largest_stable_step(student, seed):
    """Against the highest frequency that dsim finds."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(5, 2))
    rest = 0.5 * lengths(x)[0]
    masses = rng.uniform(0.2, 3.0, 5)
    system = System(masses, [Springs(PAIRS, rest, rng.uniform(5.0, 50.0, 7))], 2)
    K = system.dq(0.0, x.ravel(), np.zeros(10)).toarray()
    h = compare.number("largest_stable_step", student.call("largest_stable_step", K, np.repeat(masses, 2)))
    w = highest_frequency(system, np.concatenate([x.ravel(), np.zeros(10)]))
    compare.at_most("h w - 2", abs(h * w - 2), 1e-6)
