# loses: equilibrium, no_equilibrium, design_gradient
"""Assignment 06: quasistatics and implicit differentiation.

Write the parts that raise NotImplementedError.  `body` and `objective` are objects of kit.py: read there what they
have.  x (n,) are the free coordinates of a body in m, p (P,) its parameters.
"""

import numpy as np


def equilibrium(body, x, p, tolerance=1e-9, most=40):
    """x* (n,) with |f(x*; p)| <= tolerance (N) in every coordinate, by Newton from x; None where there is none.

    None: after `most` iterations, where df/dx cannot be inverted, or where x is no longer finite.
    """
    for _ in range(most + 1):
        f = body.force(x, p)
        if np.abs(f).max() <= 0.1:
            return x
        try:
            x = x - np.linalg.solve(body.dfdx(x, p), f)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(x).all():
            return None
    return None


def sensitivity(body, x, p):
    """dx*/dp (n, P) at the equilibrium x = x*(p); None where the condition number of df/dx is above 1e12."""
    jacobian = body.dfdx(x, p)
    if np.linalg.cond(jacobian) > 1e12:
        return None
    return -np.linalg.solve(jacobian, body.dfdp(x, p))


def adjoint_gradient(body, objective, x, p):
    """The total derivative dO/dp (P,) at the equilibrium x = x*(p), with one solve; None as in `sensitivity`."""
    jacobian = body.dfdx(x, p)
    if np.linalg.cond(jacobian) > 1e12:
        return None
    multiplier = np.linalg.solve(jacobian.T, objective.dOdx(x, p))
    return objective.dOdp(x, p) - multiplier @ body.dfdp(x, p)


def design_gradient(body, objective, x, p):
    """(O, dO/dp) of the design p: the body comes to rest first, from x.  None where it does not."""
    rest = equilibrium(body, x, p)
    if rest is None:
        return None
    return objective.value(rest, p), adjoint_gradient(body, objective, rest, p)


def gauss_newton_step(x, target, slope, damping):
    """The change of the parameters (P,) that makes |x + S dp - target|^2 + damping |dp|^2 least.

    x (n,) the equilibrium now, target (n,), slope S = dx*/dp (n, P), damping > 0 in m^2 over the unit of p squared.
    """
    matrix = slope.T @ slope + damping * np.eye(slope.shape[1])
    return np.linalg.solve(matrix, slope.T @ (target - x))
