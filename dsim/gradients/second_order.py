"""Products with second derivatives of whole simulations: a tangent sweep forward, an adjoint sweep back.

J(y_0, ..., y_N, theta) is a function of p = (y0, theta) alone; H = d2J/dp2 has as many rows as there are parameters
and is never formed.  H d is the derivative of the adjoint in the direction d (Nocedal, Wright, Numerical Optimization,
8.2, "forward over reverse"): it costs three solves an implicit stage, however many parameters there are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.gradients.adjoint import Gradient, adjoint, as_loads, gradient_of
from dsim.gradients.sensitivity import as_changes, sensitivities
from dsim.simulation import Trajectory
from dsim.steppers.stepper import FACTOR_BYTES

Second = Callable[[Array, Array], Any]  # (dy (N+1,ny), dtheta (P,)) -> the change of dJ/dy, or of it and of dJ/dtheta


class Linearizations:
    """The linearization of every step of a trajectory, made once and kept within FACTOR_BYTES (2^30) for the way back
    and for the next direction.  Raises ValueError like `adjoint`, and for a stepper without second derivatives."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.stepper, self.system = trajectory.differentiable()
        self.steps = len(trajectory.t) - 1
        self.two_step = self.stepper.history > 1
        self._kept: dict[int, Any] = {}

    @property
    def nbytes(self) -> int:
        """Memory of the rates and factors kept."""
        return sum(linear.nbytes for linear in self._kept.values())

    def at(self, n: int) -> Any:
        """Of the step from t_n; n = -1 for the one that made the first state's past."""
        if n in self._kept:
            return self._kept[n]
        step = self.trajectory.step(n) if n >= 0 else self.trajectory.start()
        linear: Any = self.stepper.linearize(self.system, step)
        if not hasattr(linear, "pullback_tangent"):
            name = type(self.stepper).__name__
            raise ValueError(f"stepper must offer second derivatives (push, pullback_tangent); {name} has none")
        first = next(iter(self._kept.values()), None)
        if first is None or (len(self._kept) + 1) * first.nbytes <= FACTOR_BYTES:
            self._kept[n] = linear
        return linear


def hessian_product(
    trajectory: Trajectory,
    dJdy: Any,
    direction: tuple[Any, Any],
    d2J: Second | None = None,
    linearizations: Linearizations | None = None,
) -> Gradient:
    """H d for the direction d = (dy0 (ny,), dtheta (P,)), None for 0; in the form of a gradient, `.y0` and `.theta`.

    dJdy (N+1,ny), or (ny,) for J(y_N): the same as for `adjoint`.  d2J: what J itself bends.  A callable (dy, dtheta)
    -> the change of dJ/dy along the states' change dy (N+1,ny), in either shape of dJdy; or a pair, with the change of
    dJ/dtheta, (P,) or named parts.  For J = |y_N|^2 / 2 it is `lambda dy, dtheta: dy[-1]`; None where J is linear.
    linearizations: `Linearizations(trajectory)`, to share factors between several directions.

    The sweeps, with the duals (mu, dmu):  dy_{n+1} = tangent(dy_n, dtheta),  then backward the derivative of
    mu_n = dJ/dy_n + pullback(mu_{n+1})  along them.  Raises ValueError on wrong shapes, and like `adjoint`.

    SciPy's solvers take it as an operator, here by the start alone:

    >>> import numpy as np
    >>> from scipy.sparse.linalg import LinearOperator
    >>> from dsim import scenes, simulate
    >>> scene = scenes.pendulum_spring()
    >>> run = simulate(scene.stepper, scene.system, scene.y0, scene.h, steps=10)
    >>> bends = lambda dy, dtheta: dy[-1]  # J = |y_N|^2 / 2
    >>> def product(d):
    ...     return hessian_product(run, run.last, (d, None), bends).y0
    >>> H = LinearOperator((run.last.size, run.last.size), matvec=product, dtype=float)
    >>> whole = H @ np.eye(run.last.size)
    >>> bool(np.allclose(whole, whole.T, rtol=1e-9))
    True
    """
    linear = linearizations or Linearizations(trajectory)
    if linear.trajectory is not trajectory:
        raise ValueError("linearizations must be those of this trajectory; got another one's")
    dy0, dtheta = as_direction(linear.system, direction)
    loads = np.zeros((linear.steps + 1, linear.system.size, 2))
    _add_loads(loads[..., 0], "dJdy", dJdy, trajectory)
    dy, changes = _forward(linear, dy0, dtheta)
    explicit = None
    if d2J is not None:
        turned, explicit = _second(d2J, dy, dtheta)
        _add_loads(loads[..., 1], "d2J's change of dJdy", turned, trajectory)
    by_start, by_theta = _backward(linear, loads, changes, dtheta)
    return gradient_of(linear.system, by_start, by_theta, explicit)


def as_direction(system: Any, direction: Any) -> tuple[Array, Array]:
    """(dy0 (ny,), dtheta (P,)) from a pair in which None counts as 0, or ValueError."""
    if not isinstance(direction, tuple) or len(direction) != 2:
        raise ValueError(f"direction must be a pair (dy0, dtheta), None for a part that is 0; got {direction!r:.60}")
    dy0, dtheta = as_changes(system, *direction)
    if dy0.shape[1:] not in ((), (1,)):
        raise ValueError(f"direction must be one direction; got {dy0.shape[1]} columns")
    return dy0.ravel(), dtheta.ravel()


def _add_loads(total: Array, name: str, given: Any, trajectory: Trajectory) -> None:
    if callable(given):
        given = [given(n, y) for n, y in enumerate(trajectory.y)]
    loads = as_loads(name, given, trajectory)
    if loads.ndim == 2:
        total += loads
    else:
        total[-1] += loads


def _second(d2J: Any, dy: Array, dtheta: Array) -> tuple[Any, Any]:
    if not callable(d2J):
        raise ValueError(f"d2J must be a callable (dy, dtheta) -> change of dJdy; got {d2J!r:.60}")
    answer = d2J(dy, dtheta)
    if not isinstance(answer, tuple):
        return answer, None
    if len(answer) != 2:
        raise ValueError(f"d2J must return the change of dJdy, or of (dJdy, dJdtheta); got {len(answer)} parts")
    return answer


def _forward(linear: Linearizations, dy0: Array, dtheta: Array) -> tuple[Array, dict[int, Any]]:
    """The change of every state (N+1,ny), and inside every step."""
    change, states, inside = dy0, [dy0], {}
    if linear.two_step:
        change, inside[-1] = linear.at(-1).push(change, dtheta)
    for n in range(linear.steps):
        change, inside[n] = linear.at(n).push(change, dtheta)
        states.append(change[: dy0.size])
    return np.stack(states), inside


def _backward(linear: Linearizations, loads: Array, changes: dict[int, Any], dtheta: Array) -> tuple[Array, Array]:
    """The derivative of the adjoint: loads (N+1,ny,2) are dJ/dy and its change."""
    size = linear.system.size
    mu = np.zeros((linear.stepper.history * size, 2))
    bars = np.zeros(linear.system.parameter_count), np.zeros(linear.system.parameter_count)
    for n in range(linear.steps - 1, -1, -1):
        mu[:size] += loads[n + 1]
        mu = linear.at(n).pullback_tangent(mu, changes[n], dtheta, bars)
    if linear.two_step:
        mu = linear.at(-1).pullback_tangent(mu, changes[-1], dtheta, bars)
    return mu[:, 1] + loads[0, :, 1], bars[1]


# Gauss-Newton: J = r^T W r / 2 without the second derivatives of the simulation


def jacobian_product(trajectory: Trajectory, drdy: Any, direction: tuple[Any, Any], drdtheta: Any = None) -> Array:
    """(dr/dp) d (m,) of residuals r(y_0, ..., y_N, theta) (m,): one tangent sweep.

    drdy (m, (N+1) ny), sparse or not, columns in the order of `trajectory.y.ravel()`; drdtheta (m,P) where r depends
    on the parameters itself.
    """
    _, system = trajectory.differentiable()
    dy0, dtheta = as_direction(system, direction)
    by_states, by_theta = _as_jacobians(trajectory, drdy, drdtheta)
    dr: Array = by_states @ np.concatenate(list(sensitivities(trajectory, dy0, dtheta)))
    return dr if by_theta is None else dr + by_theta @ dtheta


def jacobian_transposed(trajectory: Trajectory, drdy: Any, u: Any, drdtheta: Any = None) -> Gradient:
    """(dr/dp)^T u for u (m,): one adjoint sweep."""
    by_states, by_theta = _as_jacobians(trajectory, drdy, drdtheta)
    u = as_array("u", u, (by_states.shape[0],))
    loads = (by_states.T @ u).reshape(len(trajectory.t), -1)
    return adjoint(trajectory, loads, None if by_theta is None else by_theta.T @ u)


def gauss_newton_product(
    trajectory: Trajectory, drdy: Any, direction: tuple[Any, Any], drdtheta: Any = None, weights: Any = None
) -> Gradient:
    """(dr/dp)^T W (dr/dp) d, the Hessian of J = r^T W r / 2 without what r itself bends; never negative along d.

    Equal to H d where r = 0 or the simulation is linear.  drdy and drdtheta as in `jacobian_product`; weights W: (m,),
    or (m,m) symmetric; 1 without them.  A tangent and an adjoint sweep.  Raises ValueError on wrong shapes.
    """
    dr = jacobian_product(trajectory, drdy, direction, drdtheta)
    if weights is not None:
        if np.shape(weights) not in ((dr.size,), (dr.size, dr.size)):
            raise ValueError(f"weights must have shape ({dr.size},) or {(dr.size,) * 2}; got {np.shape(weights)}")
        dr = weights @ dr if len(np.shape(weights)) == 2 else np.asarray(weights) * dr
    return jacobian_transposed(trajectory, drdy, dr, drdtheta)


def _as_jacobians(trajectory: Trajectory, drdy: Any, drdtheta: Any) -> tuple[Any, Any]:
    """Both as matrices of the right shapes, or ValueError."""
    system = trajectory.attached()[1]
    rows = np.shape(drdy)[0] if np.ndim(drdy) or hasattr(drdy, "shape") else 0
    columns = len(trajectory.t) * system.size
    if np.shape(drdy) != (rows, columns):
        raise ValueError(f"drdy must have shape (m, {columns}), (m, (N+1) ny); got {np.shape(drdy)}")
    if drdtheta is not None and np.shape(drdtheta) != (rows, system.parameter_count):
        raise ValueError(f"drdtheta must have shape {(rows, system.parameter_count)}; got {np.shape(drdtheta)}")
    drdy, drdtheta = (np.asarray(a) if isinstance(a, list | tuple) else a for a in (drdy, drdtheta))
    return drdy, drdtheta
