"""Hanging nets of springs.  Lecture: "Mass-spring systems"."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, as_count
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.scenes.scene import Scene, at_rest
from dsim.steppers import BDF2, BackwardEuler
from dsim.system import System


def chain(
    links: int = 20,
    stiffness: float = 4000.0,
    damping: float = 0.2,
    both: bool = False,
    h: float = 0.01,
    steps: int = 200,
) -> Scene:
    """A chain of 1 m and 0.5 kg, straight at first, hung at its left end, or at both ends.

    Let go along the horizontal at one end it falls and cracks like a whip; between two hooks 0.9 m apart it starts
    as a shallow V and settles to a catenary.  stiffness N/m and damping kg/s of each link.
    """
    links = as_count("links", links, least=1)
    s = np.linspace(0, 1, links + 1)
    drop = np.sqrt(0.5**2 - 0.45**2) * (1 - np.abs(2 * s - 1))  # of a V with arms of 0.5 m
    x = np.stack([0.9 * s if both else s, -drop if both else 0 * s], axis=1)
    edges = np.stack([np.arange(links), np.arange(1, links + 1)], axis=1)
    effects = [Gravity([0.0, -9.81]), Springs(edges, 1 / links, stiffness), SpringDamping(edges, damping), Drag(0.005)]
    fixed = [0, links] if both else [0]
    system = System(np.full(links + 1, 0.5 / (links + 1)), effects, dimension=2, fixed=fixed)
    summary = "A chain between two hooks" if both else "A chain let go at one end, which swings down like a whip"
    return Scene("chain", summary, system, at_rest(x), h, steps, BDF2(), edges=edges)


def cloth(
    n: int = 12, stiffness: float = 300.0, shear: float = 60.0, drag: float = 0.3, h: float = 0.02, steps: int = 100
) -> Scene:
    """A cloth of 1 m x 1 m and 0.3 kg, n x n points, horizontal at first, pinned at two neighbouring corners.

    stiffness: of the springs along the threads, shear: of those along the diagonals, N/m.  drag: of the whole
    cloth, kg/s.
    """
    n = as_count("n", n, least=2)
    x, threads, diagonals = lattice((n, n), 1 / (n - 1))
    edges = np.concatenate([threads, diagonals])
    rest = np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    strength = np.repeat([stiffness, shear], [len(threads), len(diagonals)])
    effects = [Gravity([0.0, 0.0, -9.81]), Springs(edges, rest, strength), Drag(drag / n**2)]
    corners = [0, n * (n - 1)]  # (0, 0) and (1, 0)
    system = System(np.full(n * n, 0.3 / n**2), effects, dimension=3, fixed=corners)
    x = np.column_stack([x, np.zeros(n * n)])
    summary = "A cloth pinned at two corners, falling from the horizontal"
    return Scene("cloth", summary, system, at_rest(x), h, steps, BackwardEuler(), edges=edges)


def lattice(counts: tuple[int, int], spacing: float) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """A grid of points (N,2) m, the pairs of neighbours (E,2), and both diagonals of every square.

    Point (i, j) is number i * counts[1] + j, at (i, j) * spacing.
    """
    number = np.arange(counts[0] * counts[1]).reshape(counts)
    x = spacing * np.array(list(itertools.product(*map(range, counts))), dtype=float)
    sides = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:])]
    crosses = [(number[:-1, :-1], number[1:, 1:]), (number[1:, :-1], number[:-1, 1:])]
    along, across = (
        np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs]) for pairs in (sides, crosses)
    )
    return x, along, across
