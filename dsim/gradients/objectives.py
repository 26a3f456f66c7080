"""Objectives of whole simulations as functions of a few numbers, in the form SciPy's optimisers take.

    p  ->  (y0, theta)  ->  trajectory  ->  O(x(p), p)          and back, by the adjoint.

Lecture: "What about dynamics?", control as an optimisation problem.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, as_array
from dsim.gradients.adjoint import Gradient, adjoint
from dsim.gradients.second_order import Linearizations, hessian_product, jacobian_product, jacobian_transposed
from dsim.gradients.sensitivity import sensitivities
from dsim.simulation import Trajectory

if TYPE_CHECKING:
    from scipy.sparse.linalg import LinearOperator

Run = Callable[[Any, Array], Trajectory]  # (system, y0) -> trajectory


@dataclass(frozen=True, eq=False)
class Variables:
    """Which numbers are turned: p (k,), entries of the start y0 and of the parameters theta.

    wrt: names, "y0", "positions", "velocities", of bodies "attitudes" and "spins", and those of `system.theta`; or
    names with the flat indices of the entries that are turned, {"velocities": [3, 4, 5], "springs.stiffness": ...}
    (... for all).  The rest stays as in system and y0.  Raises ValueError on unknown names, on indices that do not
    exist, and where one number is twice.

    >>> from dsim import scenes
    >>> cloth = scenes.cloth(n=3)
    >>> Variables(cloth.system, cloth.y0, ["springs.stiffness"]).start.shape
    (20,)
    """

    system: Any
    y0: Array
    wrt: Any  # stored as {name: entries of (y0, theta)}

    def __post_init__(self) -> None:
        object.__setattr__(self, "y0", as_array("y0", self.y0, (self.system.size,)))
        object.__setattr__(self, "wrt", _entries(self.wrt, _known(self.system)))

    @cached_property
    def entries(self) -> NDArray[np.int64]:
        """The place of every variable in (y0, theta), (k,)."""
        return np.concatenate(list(self.wrt.values()))

    @cached_property
    def start(self) -> Array:
        """p of the given system and y0, (k,)."""
        return np.concatenate([self.y0, self.system.theta])[self.entries]

    def __len__(self) -> int:
        return len(self.entries)

    def split(self, p: Array) -> dict[str, Array]:
        """p, or a gradient by p, as one array a name."""
        ends = np.cumsum([len(places) for places in self.wrt.values()])
        return dict(zip(self.wrt, np.split(np.asarray(p), ends[:-1]), strict=True))

    def place(self, p: Any) -> tuple[Any, Array]:
        """(system, y0) with the values p."""
        whole = np.concatenate([self.y0, self.system.theta])
        whole[self.entries] = as_array("p", p, (len(self),))
        y0, theta = np.split(whole, [self.system.size])
        turned = bool((self.entries >= self.system.size).any())
        return (self.system.with_theta(theta) if turned else self.system), y0

    def gather(self, gradient: Gradient) -> Array:
        """dJ/dp (k,) from dJ/dy0 and dJ/dtheta."""
        return np.concatenate([gradient.y0, gradient.theta])[self.entries]

    def spread(self, dp: Any) -> tuple[Array, Array]:
        """dp (k,) or (k,m) -> (dy0, dtheta), for sensitivities."""
        dp = np.asarray(dp, dtype=float)
        whole = np.zeros((self.system.size + self.system.parameter_count, *dp.shape[1:]))
        whole[self.entries] = dp
        return whole[: self.system.size], whole[self.system.size :]


def _known(system: Any) -> dict[str, NDArray[np.int64]]:
    """Every name, and where its numbers lie in (y0, theta)."""
    places, ny = getattr(system, "width", system.n), system.size
    parts = {name: part.ravel() for name, part in system.split(np.arange(system.parameter_count)).items()}
    known = {"y0": np.arange(ny), "positions": np.arange(places), "velocities": np.arange(places, ny)}
    if frame := getattr(system, "frame", None):  # rigid bodies
        known |= {"attitudes": frame.turns(np.arange(places)).ravel(), "spins": places + frame.spin_dofs.ravel()}
    return known | {name: ny + part for name, part in parts.items()}


def _entries(wrt: Any, known: Mapping[str, NDArray[np.int64]]) -> dict[str, NDArray[np.int64]]:
    if isinstance(wrt, str) or not isinstance(wrt, Iterable):
        raise ValueError(f'wrt must be names such as ["springs.stiffness"]; got {wrt!r:.60}')
    chosen = wrt.items() if isinstance(wrt, Mapping) else ((name, ...) for name in wrt)
    found = {}
    for name, indices in chosen:
        if not isinstance(name, str) or name not in known:
            raise ValueError(f"wrt must name some of {', '.join(known)}; got {name!r:.60}")
        if name in found:
            raise ValueError(f"wrt must name every number once; {name!r} comes twice")
        try:
            found[name] = np.atleast_1d(known[name][indices if indices is ... else np.asarray(indices)])
        except IndexError as error:
            count = len(known[name])
            raise ValueError(f"wrt[{name!r}] must be indices from 0 to {count - 1}; got {indices!r:.60}") from error
    together = np.concatenate([np.empty(0, dtype=np.int64), *found.values()])
    if not len(together):
        raise ValueError("wrt must name at least one number; got none")
    if len(np.unique(together)) < len(together):
        raise ValueError(f"wrt must name every number once; {', '.join(found)} overlap")
    return found


@dataclass(frozen=True, eq=False)
class ReducedObjective:
    """p -> (O(x(p), p), dO/dp), for `scipy.optimize.minimize(..., jac=True)`.

    run: (system, y0) -> trajectory, for instance a `simulate` with its stepper, h and steps.
    objective: trajectory -> (O, dO/dy) with dO/dy (N+1,ny), or (ny,) for one of the last state; with a third entry
    dO/dtheta, (P,) or named parts, where O depends on the parameters itself.  Where `run` keeps `Checkpoints`, O is of
    the last state (`trajectory.last`); a running cost's dO/dy may be a callable (n, y_n) -> (ny,), as for `adjoint`,
    but its value needs all states.
    second: for `hessp`, what the objective itself bends: (trajectory, dy (N+1,ny), dtheta (P,)) -> the change of dO/dy,
    or a pair with the change of dO/dtheta, as d2J of `hessian_product`.
    Raises ValueError where O is not finite or a derivative has another shape, SimulationError where a run fails.

    >>> import scipy.optimize
    >>> from dsim import scenes, simulate
    >>> ball = scenes.projectile()
    >>> aim = Variables(ball.system, ball.y0, ["velocities"])
    >>> def miss(trajectory):  # half the squared distance from (3, 1) at the end
    ...     gap = np.append(trajectory.last[:2] - [3.0, 1.0], [0.0, 0.0])
    ...     return gap @ gap / 2, gap
    >>> run = lambda system, y0: simulate(ball.stepper, system, y0, ball.h, ball.steps)
    >>> found = scipy.optimize.minimize(ReducedObjective(run, aim, miss), aim.start, jac=True)
    >>> bool(found.fun < 1e-10)
    True

    With the Hessian's products, Newton's method:

    >>> def bends(trajectory, dy, dtheta):
    ...     return np.append(dy[-1, :2], [0.0, 0.0])
    >>> fit = ReducedObjective(run, aim, miss, bends)
    >>> found = scipy.optimize.minimize(fit, aim.start, jac=True, hessp=fit.hessp, method="trust-ncg")
    >>> bool(found.fun < 1e-20)
    True
    """

    run: Run
    variables: Variables
    objective: Callable[[Trajectory], Any]
    second: Callable[[Trajectory, Array, Array], Any] | None = None
    _last: dict[bytes, tuple[Linearizations, float, Any, Any]] = field(default_factory=dict, init=False, repr=False)

    def __call__(self, p: Any) -> tuple[float, Array]:
        linear, value, dOdy, dOdtheta = self._at(p)
        trajectory = linear.trajectory
        return value, self.variables.gather(adjoint(trajectory, dOdy, dOdtheta))

    def hessp(self, p: Any, dp: Any) -> Array:
        """d2O/dp2 dp (k,), exact: for `minimize(fit, start, jac=True, hessp=fit.hessp, method="trust-ncg")`, or
        "Newton-CG", "trust-krylov", "trust-constr".  Products at one p share the run and its factors."""
        second = self.second
        if second is None:
            raise ValueError("second must be given to ReducedObjective for hessp: the change of dOdy along a path's")
        linear, _, dOdy, _ = self._at(p)
        direction = self.variables.spread(as_array("dp", np.ravel(dp), (len(self.variables),)))
        bends = partial(second, linear.trajectory)
        return self.variables.gather(hessian_product(linear.trajectory, dOdy, direction, bends, linear))

    def _at(self, p: Any) -> tuple[Linearizations, float, Any, Any]:
        """The run at p and what the objective says of it; the last one is kept where products are asked for."""
        key = np.asarray(p, dtype=float).tobytes()
        if key in self._last:
            return self._last[key]
        trajectory = _run(self.run, self.variables, p)
        found = (Linearizations(trajectory), *_answer(self.objective(trajectory)))
        if self.second is not None:
            self._last.clear()
            self._last[key] = found
        return found


def _run(run: Run, variables: Variables, p: Any) -> Trajectory:
    """The trajectory at p.  One of another system or start would have a gradient too, by other numbers."""
    system, y0 = variables.place(p)
    trajectory = run(system, y0)
    if not isinstance(trajectory, Trajectory):
        raise ValueError(f"run must return a Trajectory; got {trajectory!r:.60}")
    _, simulated = trajectory.differentiable()
    if not (np.array_equal(trajectory.first, y0) and np.array_equal(simulated.theta, system.theta)):
        raise ValueError("run must simulate the system and the y0 it is given; this trajectory has others")
    return trajectory


def _answer(answer: Any) -> tuple[float, Any, Any]:
    if not isinstance(answer, tuple) or len(answer) not in (2, 3):
        raise ValueError(f"objective must return (value, dOdy) or (value, dOdy, dOdtheta); got {answer!r:.60}")
    try:
        value = float(as_array("value", answer[0], ()))
    except ValueError as error:
        raise ValueError(f"objective must return a finite number; got {answer[0]!r:.60}") from error
    return value, answer[1], answer[2] if len(answer) == 3 else None


@dataclass(frozen=True, eq=False)
class Residuals:
    """p -> r(x(p), p) (m,), and `jacobian`: for `scipy.optimize.least_squares(r, r.variables.start, jac=r.jacobian)`.

    residual: trajectory -> (r, dr/dy) with dr/dy (m, (N+1) ny), sparse or not, columns in the order of
    `trajectory.y.ravel()`; with a third entry dr/dtheta (m,P) where r depends on the parameters itself.
    The Jacobian takes forward sensitivities, all columns on one factorization a step.
    """

    run: Run
    variables: Variables
    residual: Callable[[Trajectory], Any]
    _last: dict[bytes, Any] = field(default_factory=dict, init=False, repr=False)  # SciPy asks for r, then for dr/dp

    def __call__(self, p: Any) -> Array:
        return self._at(p)[1]

    def _at(self, p: Any) -> tuple[Trajectory, Array, Any, Any]:
        key = np.asarray(p, dtype=float).tobytes()
        if key not in self._last:
            trajectory = _run(self.run, self.variables, p)
            self._last.clear()
            self._last[key] = (trajectory, *_residual_answer(self.residual(trajectory), trajectory))
        found: tuple[Trajectory, Array, Any, Any] = self._last[key]
        return found

    def jacobian(self, p: Any) -> Array:
        """dr/dp (m,k)."""
        trajectory, r, drdy, drdtheta = self._at(p)
        dy0, dtheta = self.variables.spread(np.eye(len(self.variables)))
        total = np.zeros((len(r), len(self.variables)))
        ny = len(dy0)
        for n, change in enumerate(sensitivities(trajectory, dy0, dtheta)):
            block = drdy[:, n * ny : (n + 1) * ny]
            if block.nnz:
                total += block @ change
        return total if drdtheta is None else total + drdtheta @ dtheta

    def operator(self, p: Any) -> LinearOperator:
        """dr/dp (m,k) as an operator: a product is one tangent sweep, one with the transpose one adjoint sweep.

        For many variables, `least_squares(r, start, jac=r.operator, tr_solver="lsmr")`; J^T J d is the Gauss-Newton
        product.
        """
        from scipy.sparse.linalg import LinearOperator

        trajectory, r, drdy, drdtheta = self._at(p)

        def matvec(dp: Array) -> Array:
            return jacobian_product(trajectory, drdy, self.variables.spread(np.ravel(dp)), drdtheta)

        def rmatvec(u: Array) -> Array:
            return self.variables.gather(jacobian_transposed(trajectory, drdy, np.ravel(u), drdtheta))

        return LinearOperator((len(r), len(self.variables)), matvec=matvec, rmatvec=rmatvec, dtype=float)


def _residual_answer(answer: Any, trajectory: Trajectory) -> tuple[Array, Any, Any]:
    from scipy.sparse import csc_array

    if not isinstance(answer, tuple) or len(answer) not in (2, 3):
        raise ValueError(f"residual must return (r, drdy) or (r, drdy, drdtheta); got {answer!r:.60}")
    r = as_array("residual's r", answer[0], (None,))
    drdy, shape = csc_array(answer[1]), (len(r), trajectory.y.size)
    if drdy.shape != shape:
        raise ValueError(f"residual's drdy must have shape {shape}, (m, (N+1) ny); got {drdy.shape}")
    as_array("residual's drdy", drdy.data)
    if len(answer) == 2:
        return r, drdy, None
    wanted = (len(r), trajectory.attached()[1].parameter_count)
    if np.shape(answer[2]) != wanted:
        raise ValueError(f"residual's drdtheta must have shape {wanted}, (m, P); got {np.shape(answer[2])}")
    drdtheta = csc_array(answer[2])
    as_array("residual's drdtheta", drdtheta.data)
    return r, drdy, drdtheta
