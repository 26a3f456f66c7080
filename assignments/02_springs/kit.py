"""What is given: small nets to try your functions on.  Points x (N,d) m, pairs (E,2), rest lengths (E,) m."""

import numpy as np


def triangle():
    """Three points in the plane, three springs: one stretched, one pressed together, one at rest."""
    x = np.array([[0.0, 0.0], [1.0, 0.0], [0.2, 0.9]])
    pairs = np.array([[0, 1], [1, 2], [2, 0]])
    lengths = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    return x, pairs, lengths * np.array([0.8, 1.3, 1.0])


def star(points=6):
    """A point in the middle of a ring, in 3-D: many springs meet in point 0."""
    angle = 2 * np.pi * np.arange(points) / points
    ring = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.arange(points)], axis=1)
    x = np.concatenate([[[0.0, 0.0, 0.0]], ring])
    pairs = np.array([[0, i + 1] for i in range(points)])
    return x, pairs, np.full(points, 0.9)
