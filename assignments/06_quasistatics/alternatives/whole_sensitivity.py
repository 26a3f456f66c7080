"""The inverse of df/dx, and every gradient through the whole sensitivity; least squares from a stacked matrix."""

import numpy as np


def equilibrium(body, x, p, tolerance=1e-9, most=40):
    """Newton's method that halves a step as long as the force grows."""
    f = body.force(x, p)
    for _ in range(most):
        size = np.abs(f).max()
        if size <= tolerance:
            return x
        matrix = body.dfdx(x, p)
        if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix) < len(x):
            return None
        step = np.linalg.inv(matrix) @ f
        for _ in range(30):
            f = body.force(x - step, p)
            if np.isfinite(f).all() and np.abs(f).max() < size:
                break
            step = step / 2
        x = x - step
    return x if np.abs(f).max() <= tolerance else None


def sensitivity(body, x, p):
    values = np.linalg.svd(body.dfdx(x, p), compute_uv=False)
    if values[-1] * 1e12 < values[0]:
        return None
    return np.linalg.inv(-body.dfdx(x, p)) @ body.dfdp(x, p)


def adjoint_gradient(body, objective, x, p):
    slope = sensitivity(body, x, p)
    return None if slope is None else slope.T @ objective.dOdx(x, p) + objective.dOdp(x, p)


def design_gradient(body, objective, x, p):
    x = equilibrium(body, x, p)
    return None if x is None else [np.float64(objective.value(x, p)), adjoint_gradient(body, objective, x, p)]


def gauss_newton_step(x, target, slope, damping):
    count = slope.shape[1]
    stacked = np.concatenate([slope, damping**0.5 * np.identity(count)])
    return np.linalg.lstsq(stacked, np.concatenate([target - x, np.zeros(count)]), rcond=None)[0]
