"""LU factors from SciPy, used in both directions; the signs put elsewhere; the step from the dual system."""

import numpy as np
from scipy.linalg import lu_factor, lu_solve


def usable(matrix):
    return np.isfinite(matrix).all() and np.linalg.cond(matrix) <= 1e12


def equilibrium(body, x, p, tolerance=1e-9, most=40):
    x = x.copy()
    count = 0
    while np.abs(residual := -body.force(x, p)).max() > tolerance:
        stiffness = body.dfdx(x, p)
        count += 1
        if count > most or not usable(stiffness):
            return None
        x += lu_solve(lu_factor(stiffness), residual)
    return x


def sensitivity(body, x, p):
    stiffness = -body.dfdx(x, p)
    if not usable(stiffness):
        return None
    factors = lu_factor(stiffness)
    return np.column_stack([lu_solve(factors, column) for column in body.dfdp(x, p).T])


def adjoint_gradient(body, objective, x, p):
    stiffness = -body.dfdx(x, p)
    if not usable(stiffness):
        return None
    multiplier = lu_solve(lu_factor(stiffness), objective.dOdx(x, p), trans=1)
    gradient = objective.dOdp(x, p)
    for j, column in enumerate(body.dfdp(x, p).T):
        gradient[j] += multiplier @ column
    return gradient


def design_gradient(body, objective, x, p):
    x = equilibrium(body, x, p, 1e-12)
    if x is not None:
        return objective.value(x, p), adjoint_gradient(body, objective, x, p)
    return None


def gauss_newton_step(x, target, slope, damping):
    return slope.T @ np.linalg.solve(slope @ slope.T + damping * np.eye(len(x)), target - x)
