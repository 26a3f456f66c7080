"""The spring  U = k/2 (|x_ij| - l0)^2.  Lecture: "Mass-spring systems"; the force on i is -dU/dx_i.

Written with the edge e = x_j - x_i, its length l and its direction n = e / l:
the tension is k (l - l0), the edge hessian is k [ n n^T + (1 - l0/l) (I - n n^T) ].
Coincident ends have no direction: there n = 0 and l0/l counts as 0, so the force is 0 and everything is finite.
"""

from __future__ import annotations

import numpy as np

from dsim.arrays.checks import Array
from dsim.kernels.kernel import Kernel


def directions(edge: Array) -> tuple[Array, Array]:
    """Lengths (E,) and unit directions (E,d) of edges (E,d); the direction of a zero edge is 0."""
    length = np.sqrt(np.einsum("ed,ed->e", edge, edge))
    scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)
    return length, edge * scale[:, None]


def turning(edge: Array, change: Array) -> tuple[Array, Array]:
    """How lengths (E,) and directions (E,d) change with the edges: dl = n.de, dn = (de - n dl)/l, 0 at a zero edge."""
    length, n = directions(edge)
    dl = np.einsum("ed,ed->e", n, change)
    return dl, slackness(length, np.ones_like(length))[:, None] * (change - dl[:, None] * n)


def slackness(length: Array, rest: Array) -> Array:
    """l0/l, and 0 where the ends coincide."""
    ratio: Array = np.divide(rest, length, out=np.zeros_like(length), where=length > 0)
    return ratio


def both_ends(value: Array) -> Array:
    """(E,d,...) of the edge x_j - x_i -> (E,2,d,...) of the ends: minus at i, plus at j."""
    return np.stack([-value, value], axis=1)


def both_pairs(block: Array) -> Array:
    """(E,d,d) of the edge -> (E,2,d,2,d) of the ends: [[B,-B],[-B,B]]."""
    signs = np.array([[1.0, -1.0], [-1.0, 1.0]])
    pairs: Array = signs[None, :, None, :, None] * block[:, None, :, None, :]
    return pairs


def energy(x: Array, theta: Array) -> Array:
    """U = k/2 (l - l0)^2.  x (E,2,d) m, theta (E,2) = (rest length m, stiffness N/m) -> (E,) J."""
    length, _ = directions(x[:, 1] - x[:, 0])
    rest, stiffness = theta.T
    value: Array = 0.5 * stiffness * (length - rest) ** 2
    return value


def tension(edge: Array, theta: Array) -> Array:
    """k (l - l0) n, the gradient by the edge (E,d) -> (E,d) N.  theta (2,E): rest lengths and stiffnesses."""
    length, n = directions(edge)
    rest, stiffness = theta
    pull: Array = (stiffness * (length - rest))[:, None] * n
    return pull


def gradient(x: Array, theta: Array) -> Array:
    """dU/dx = k (l - l0) n at j, the opposite at i -> (E,2,d) N."""
    return both_ends(tension(x[:, 1] - x[:, 0], theta.T))


def edge_hessian(edge: Array, theta: Array) -> Array:
    """k [ (1 - l0/l) I + l0/l n n^T ], the form without a cancelling difference -> (E,d,d) N/m.  theta (2,E)."""
    length, n = directions(edge)
    rest, stiffness = theta
    slack = slackness(length, rest)
    block: Array = ((stiffness * slack)[:, None] * n)[:, :, None] * n[:, None, :]
    diagonal = np.arange(edge.shape[1])
    block[:, diagonal, diagonal] += (stiffness * (1 - slack))[:, None]
    return block


def hessian(x: Array, theta: Array) -> Array:
    """d2U/dx2 -> (E,2,d,2,d) N/m.  Indefinite where a spring is compressed: exact, never projected."""
    return both_pairs(edge_hessian(x[:, 1] - x[:, 0], theta.T))


def mixed(x: Array, theta: Array) -> Array:
    """d2U/dx dtheta -> (E,2,d,2): -k n for the rest length, (l - l0) n for the stiffness."""
    length, n = directions(x[:, 1] - x[:, 0])
    rest, stiffness = theta.T
    return both_ends(np.stack([-stiffness[:, None] * n, (length - rest)[:, None] * n], axis=2))


def sample(rng: np.random.Generator) -> tuple[Array, Array]:
    """Stretched and compressed springs in general position."""
    x = rng.normal(size=(7, 2, 3))
    length, _ = directions(x[:, 1] - x[:, 0])
    theta = np.stack([length * rng.uniform(0.5, 1.8, 7), rng.uniform(0.5, 20.0, 7)], axis=1)
    return x, theta


SPRING = Kernel("spring", ("rest_length", "stiffness"), energy, gradient, hessian, mixed, sample)
