"""Hypothesis strategies: random systems, states and step sizes, for our property tests and for yours.

What they draw is well-conditioned: points keep a distance of 0.3 m, masses and stiffnesses stay within two decades,
numbers are multiples of a thousandth of their range.  A failure is then a fault of the code, not of round-off, and
shrinks towards a small system with masses and stiffnesses of 1.

>>> from hypothesis import given, settings
>>> from hypothesis import strategies as st
>>> @settings(max_examples=10, derandomize=True, database=None)
... @given(st.data())
... def forces_of_springs_add_up_to_zero(data):
...     system = data.draw(systems(dimension=3, kinds=("springs",)))
...     q, v = system.blocks(data.draw(states(system)))
...     total = system.force(0.0, q, v).reshape(-1, 3).sum(axis=0)
...     assert abs(total).max() < 1e-10
>>> forces_of_springs_add_up_to_zero()
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from dsim.arrays.checks import Array
from dsim.effects import Actuation, Drag, Effect, Field, Gravity, SpringDamping, Springs
from dsim.system import System

_RESOLUTION = 1000  # values a range is divided into: no number is tiny by accident, and all shrink in few steps
_OWN_JITTER, _DRAWN_JITTER = 0.15, 0.2  # of a lattice of spacing 1: two points keep a distance of 0.3


def numbers(shape: int | tuple[int, ...], largest: float = 1.0) -> SearchStrategy[Array]:
    """Arrays with entries from -largest to largest; they shrink to 0.

    >>> from hypothesis import find
    >>> find(numbers((2, 3)), lambda x: True).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    return _integers(shape).map(lambda i: largest * i / _RESOLUTION)


def positive_numbers(shape: int | tuple[int, ...], middle: float = 1.0, ratio: float = 2.0) -> SearchStrategy[Array]:
    """Arrays with entries from middle/ratio to middle*ratio, evenly in their logarithm; they shrink to the middle."""
    return _integers(shape).map(lambda i: middle * ratio ** (i / _RESOLUTION))


def masses(count: int, middle: float = 1.0, ratio: float = 2.0) -> SearchStrategy[Array]:
    """Masses (count,) kg, from middle/ratio to middle*ratio.

    >>> from hypothesis import find
    >>> find(masses(3), lambda m: True).tolist()
    [1.0, 1.0, 1.0]
    """
    return positive_numbers(count, middle, ratio)


def translations(dimension: int, largest: float = 3.0) -> SearchStrategy[Array]:
    """Shifts (d,) m; they shrink to 0."""
    return numbers(dimension, largest)


def rotations(dimension: int) -> SearchStrategy[Array]:
    """Proper rotations (d,d): a product of one turn in every coordinate plane.  They shrink to the identity.

    >>> from hypothesis import find
    >>> turn = find(rotations(3), lambda R: R[0, 0] < 0.5)
    >>> bool(np.allclose(turn @ turn.T, np.eye(3))), round(float(np.linalg.det(turn)), 12)
    (True, 1.0)
    """
    planes = [(i, j) for i in range(dimension) for j in range(i + 1, dimension)]

    def product(angles: Array) -> Array:
        total = np.eye(dimension)
        for (i, j), angle in zip(planes, angles, strict=True):
            turn = np.eye(dimension)
            turn[[i, j], [i, j]] = np.cos(angle)
            turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
            total = turn @ total
        return total

    return numbers(len(planes), np.pi).map(product)


def point_clouds(count: int, dimension: int) -> SearchStrategy[Array]:
    """Points (count,d) m in general position: a lattice of spacing 1, each point moved by up to 0.35 along every axis.

    Two points are at least 0.3 m apart.  The lattice itself is uneven, so that even the simplest cloud is generic.
    """
    side = round(np.ceil(count ** (1 / dimension) - 1e-9))
    sites = np.stack(np.unravel_index(np.arange(count), (side,) * dimension), axis=1)
    uneven = _OWN_JITTER * np.sin(1.7 * np.arange(1, count * dimension + 1) ** 2).reshape(count, dimension)
    return numbers((count, dimension), _DRAWN_JITTER).map(lambda jitter: sites + uneven + jitter)


@dataclass(frozen=True, eq=False)
class Network:
    """Points (N,d) m joined by springs: pairs (E,2), rest_length (E,) m, stiffness (E,) N/m."""

    points: Array
    pairs: Any
    rest_length: Array
    stiffness: Array

    @property
    def dimension(self) -> int:
        return self.points.shape[1]

    @property
    def springs(self) -> Springs:
        """The network as an effect."""
        return Springs(self.pairs, self.rest_length, self.stiffness)


@st.composite
def spring_networks(
    draw: st.DrawFn, dimension: int = 2, max_points: int = 5, stiffness: float = 10.0, relaxed: bool = False
) -> Network:
    """Connected networks of 2 to `max_points` points: a random tree, and some springs more.

    stiffness: the middle of its range, in which it varies tenfold.  Rest lengths are 0.6 to 1.6 times the lengths,
    so springs are stretched and compressed; with `relaxed` they are the lengths.

    >>> from hypothesis import find
    >>> find(spring_networks(), lambda network: len(network.pairs) > len(network.points) - 1).pairs.tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    count = draw(st.integers(2, max_points))
    tree = [(draw(st.integers(0, i - 1)), i) for i in range(1, count)]
    others = [(i, j) for i in range(count) for j in range(i + 1, count) if (i, j) not in tree]
    more = draw(st.lists(st.sampled_from(others), unique=True, max_size=count)) if others else []
    pairs = np.array(tree + sorted(more))
    points = draw(point_clouds(count, dimension))
    length = np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1)
    ratio = np.ones(len(pairs)) if relaxed else draw(positive_numbers(len(pairs), 1.0, 1.6))
    return Network(points, pairs, ratio * length, draw(positive_numbers(len(pairs), stiffness, np.sqrt(10.0))))


def effects(network: Network, kinds: Iterable[str] = ("springs",)) -> SearchStrategy[tuple[Effect, ...]]:
    """One effect of every kind, acting on the network's points.  Raises ValueError at an unknown kind.

    >>> from hypothesis import find
    >>> network = find(spring_networks(), lambda network: True)
    >>> [effect.name for effect in find(effects(network, ("gravity", "springs")), lambda e: True)]
    ['gravity', 'springs']
    """
    kinds = tuple(kinds)
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(f"kinds must be among {', '.join(KINDS)}; got {kind!r}")
    return st.tuples(*(KINDS[kind](network) for kind in kinds))


@st.composite
def systems(
    draw: st.DrawFn,
    dimension: int = 2,
    max_points: int = 5,
    kinds: Iterable[str] = ("springs",),
    pinned: bool = False,
) -> System:
    """Systems of 2 to `max_points` points, with one effect of every kind; with `pinned` some points are fixed.

    >>> from hypothesis import find
    >>> system = find(systems(dimension=3, kinds=("gravity", "springs")), lambda system: True)
    >>> system.mass.tolist(), sorted(system.split(system.theta))
    ([1.0, 1.0], ['gravity.acceleration', 'mass', 'springs.rest_length', 'springs.stiffness'])
    """
    network = draw(spring_networks(dimension, max_points))
    count = len(network.points)
    fixed = draw(st.sets(st.integers(0, count - 1), min_size=1, max_size=count - 1)) if pinned else ()
    return System(draw(masses(count)), draw(effects(network, kinds)), dimension, sorted(fixed))


def states(system: System, speed: float = 1.0) -> SearchStrategy[Array]:
    """States y (2n,) = [q, v]: points in general position, velocities up to `speed` m/s along every axis.

    >>> from hypothesis import find
    >>> find(states(System([1.0], dimension=3)), lambda y: y[-1] > 0.2).tolist()[3:]
    [0.0, 0.0, 0.201]
    """
    cloud = point_clouds(len(system.mass), system.dimension)
    return st.tuples(cloud, numbers(system.n, speed)).map(lambda qv: np.concatenate([qv[0].ravel(), qv[1]]))


def step_sizes(system: System, y: Array, largest: float = 0.5, smallest: float = 0.05) -> SearchStrategy[float]:
    """Steps h s of `smallest` to `largest` in units of the system's fastest time at y; at most `largest` s.

    The fastest time is 1/max(|M^-1 K|^(1/2), |M^-1 D|, 1/s) in the maximum norm: an explicit method is stable there.
    A system with an actuation has one step only: the actuation's.

    >>> from hypothesis import find
    >>> system = System([1.0, 1.0], Springs([(0, 1)], 1.0, 50.0), dimension=1)
    >>> find(step_sizes(system, np.array([0.0, 1.0, 0.0, 0.0])), lambda h: True)
    0.05
    """
    given = [effect.h for effect in system.effects if isinstance(effect, Actuation)]
    if given:
        return st.just(given[0])
    q, v = system.blocks(y)
    by_q, by_v = (
        np.abs(part.toarray()).sum(axis=1) / system.masses for part in (system.dq(0, q, v), system.dv(0, q, v))
    )
    fastest = 1 / max(np.sqrt(by_q.max()), by_v.max(), 1.0)
    return st.integers(-_RESOLUTION, 0).map(lambda i: float(fastest * largest * (smallest / largest) ** (-i / 1000)))


def _integers(shape: int | tuple[int, ...]) -> SearchStrategy[Array]:
    shape = (shape,) if isinstance(shape, int) else shape
    size = int(np.prod(shape))
    entries = st.lists(st.integers(-_RESOLUTION, _RESOLUTION), min_size=size, max_size=size)
    return entries.map(lambda values: np.array(values, dtype=float).reshape(shape))


# Kinds of effects: each is a strategy on a network


def _gravity(network: Network) -> SearchStrategy[Effect]:
    return numbers(network.dimension, 10.0).map(Gravity)


def _drag(network: Network) -> SearchStrategy[Effect]:
    return positive_numbers(len(network.points), 0.5).map(Drag)


def _wind(network: Network) -> SearchStrategy[Effect]:
    parts = st.tuples(positive_numbers(len(network.points), 0.5), numbers(network.dimension, 2.0))
    return parts.map(lambda p: Drag(p[0], wind=p[1], name="wind"))


def _swirl(network: Network) -> SearchStrategy[Effect]:
    """Drag in a wind that varies with time and place."""
    turn = np.roll(np.eye(network.dimension), 1, axis=0)

    def wind(t: float, x: Array) -> Array:
        return np.sin(x + t) @ turn.T

    def slope(t: float, x: Array) -> Array:
        return np.einsum("nj,ij->nij", np.cos(x + t), turn)

    return positive_numbers(len(network.points), 0.5).map(lambda c: Drag(c, wind, slope, name="swirl"))


def _field(network: Network) -> SearchStrategy[Effect]:
    """A bowl that stiffens with the distance along every axis: U = c (x^2/2 + x^4/4) a coordinate."""
    identity = np.eye(network.dimension)

    def bowl(strength: Array) -> Effect:
        c = float(strength[0])
        return Field(
            lambda x: -c * (x + x**3),
            lambda x: np.einsum("ni,ij->nij", -c * (1 + 3 * x**2), identity),
            lambda x: c * (x**2 / 2 + x**4 / 4).sum(axis=1),
        )

    return positive_numbers(1, 0.5).map(bowl)


def _springs(network: Network) -> SearchStrategy[Effect]:
    return st.just(network.springs)


def _spring_damping(network: Network) -> SearchStrategy[Effect]:
    return positive_numbers(len(network.pairs), 0.5).map(lambda c: SpringDamping(network.pairs, c))


def _actuation(network: Network) -> SearchStrategy[Effect]:
    """Five steps of 0.03 s."""
    return numbers((5, *network.points.shape), 2.0).map(lambda forces: Actuation(forces, h=0.03))


KINDS: dict[str, Callable[[Network], SearchStrategy[Effect]]] = {
    "gravity": _gravity,
    "drag": _drag,
    "wind": _wind,
    "swirl": _swirl,
    "field": _field,
    "springs": _springs,
    "spring_damping": _spring_damping,
    "actuation": _actuation,
}
