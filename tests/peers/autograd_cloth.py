"""The benchmark's cloth in HIPS autograd: plain NumPy under `autograd.numpy`, a Python loop over the steps.

autograd has no scatter-add, so forces are collected by the incidence matrix.
An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import autograd.numpy as anp
import numpy as np
from autograd import grad


def make(problem):
    """(forward, gradient): (stiffness, v0) -> final (q, v); and d(loss)/d(stiffness, v0), loss = sum of w . (q, v)."""
    rest, free = problem["rest"][:, None], problem["free"][:, None]
    h, weight_q, weight_v = problem["h"], *problem["weights"]
    springs = np.arange(len(rest))
    incidence = np.zeros((len(rest), len(free)))  # +1 at j, -1 at i
    incidence[springs, problem["pairs"][:, 0]] = -1.0
    incidence[springs, problem["pairs"][:, 1]] = 1.0

    def forward(stiffness, v0):
        q, v = problem["q0"], free * v0
        for _ in range(problem["steps"]):
            edge = anp.dot(incidence, q)
            length = anp.sqrt(anp.sum(edge**2, axis=1, keepdims=True))
            pull = stiffness[:, None] * (1 - rest / length) * edge
            force = problem["mass"] * problem["gravity"] - problem["drag"] * v - anp.dot(incidence.T, pull)
            v = v + h * free * force / problem["mass"]
            q = q + h * v
        return q, v

    def loss(stiffness, v0):
        q, v = forward(stiffness, v0)
        return anp.sum(weight_q * q) + anp.sum(weight_v * v)

    return forward, grad(loss, argnum=(0, 1))
