"""Sparse matrices; equilibrium by SciPy's root finder and one Newton step; the adjoint from the left."""

import warnings

import numpy as np
from scipy.optimize import root
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu


def equilibrium(body, x, p, tolerance=1e-9, most=40):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = root(body.force, x, args=(p,), jac=body.dfdx, tol=1e-12).x
        for _ in range(3):
            if np.linalg.norm(body.force(found, p), np.inf) <= tolerance:
                return found
            found = found - np.linalg.lstsq(body.dfdx(found, p), body.force(found, p), rcond=None)[0]
    return None


def factors(body, x, p):
    matrix = body.dfdx(x, p)
    return None if np.linalg.cond(matrix, 2) >= 1e12 else splu(csc_array(matrix))


def sensitivity(body, x, p):
    lu = factors(body, x, p)
    return None if lu is None else lu.solve(-body.dfdp(x, p))


def adjoint_gradient(body, objective, x, p):
    lu = factors(body, x, p)
    if lu is None:
        return None
    return -(lu.solve(objective.dOdx(x, p), trans="T") @ body.dfdp(x, p)) + objective.dOdp(x, p)


def design_gradient(body, objective, x, p):
    x = equilibrium(body, x, p)
    return None if x is None else (float(objective.value(x, p)), adjoint_gradient(body, objective, x, p))


def gauss_newton_step(x, target, slope, damping):
    singular = np.linalg.svd(slope, full_matrices=False)
    return singular[2].T @ (singular[1] / (singular[1] ** 2 + damping) * (singular[0].T @ (target - x)))
