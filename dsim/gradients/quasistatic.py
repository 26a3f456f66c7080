"""Quasistatics: where a body comes to rest, and how that place depends on the parameters.

Lecture: "Differentiable simulation".  The equilibrium x*(p) is implicitly defined by f(x*; p) = 0, hence
dx*/dp = -(df/dx)^-1 df/dp.  It is a trajectory of length one whose linearization has B = 0, except at the pins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array, as_array, as_count, as_positive
from dsim.gradients.adjoint import Gradient
from dsim.gradients.statics import StaticProblem
from dsim.solve.linear import Factor, factorize
from dsim.solve.newton import Status
from dsim.steppers.stepper import Counters
from dsim.system import System

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class EquilibriumError(RuntimeError):
    """No equilibrium, or none that can be differentiated.  `equilibrium` holds the last place, `status` says why."""

    def __init__(self, message: str, equilibrium: Equilibrium) -> None:
        super().__init__(message)
        self.equilibrium = equilibrium
        self.status = equilibrium.status


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """Where a search for an equilibrium ended.  q (n,) m.

    status: `converged` for an equilibrium - a stable one where the system has a potential -; `singular` at a fold or
    bifurcation, or `unstable`, both in balance; else why there is none: `no_equilibrium`, `max_iterations`,
    `line_search_failed` or `not_finite`.
    imbalance: the largest |f| of a free coordinate over the largest force that acts anywhere.
    eigenvalue: the smallest of -df/dq over the largest.  kicks: how often an unstable equilibrium was left.
    """

    system: System = field(repr=False)
    t: float
    q: Array
    status: Status
    imbalance: float
    eigenvalue: float = np.nan
    kicks: int = 0
    counters: Counters = Counters()
    factor: Factor | None = field(default=None, repr=False)  # of -df/dq, where the search had to make it

    @property
    def y(self) -> Array:
        """The state [q, 0] (2n,), from which a simulation stays where it is."""
        return np.concatenate([self.q, np.zeros_like(self.q)])

    def linearize(self) -> EquilibriumLinearization:
        """dx*/dp in both directions.  Raises EquilibriumError unless the status is `converged`."""
        if self.status is not Status.CONVERGED:
            raise EquilibriumError(explain(self), self)
        return EquilibriumLinearization(self)

    def adjoint(self, dOdq: Any, dOdtheta: Any = None) -> Gradient:
        """The gradient of an objective O(x*, p) from its partial derivatives: dO/dp = dO/dx* dx*/dp + dO/dp.

        dOdq (n,).  dOdtheta: the explicit part, (P,) or a mapping {"springs.stiffness": (E,), ...}; none by default.
        `.y0` holds the gradient by the positions of the pins.  Raises ValueError on wrong shapes and unknown names,
        EquilibriumError unless the status is `converged`.
        """
        dOdq = as_array("dOdq", dOdq, (self.system.n,))
        theta_bar = _explicit(self.system, dOdtheta)
        pins = self.linearize().pullback(dOdq, theta_bar)
        return Gradient(np.concatenate([pins, np.zeros_like(pins)]), theta_bar, self.system.split(theta_bar))


def quasistatic(
    system: System, q0: Any, *, t: float = 0.0, tol: float = 1e-10, max_iterations: int = 500, kicks: int = 8
) -> Equilibrium:
    """The equilibrium f(t, x*, v = 0; p) = 0 that descent of the energy from q0 (n,) finds.

    Where every effect has a potential (damping needs none), Newton directions of a stiffness made definite, with
    Armijo's line search on the potential, lead to a minimum: at any other stationary point the descent goes on along
    a direction of negative curvature, at most `kicks` times.  Without a potential Newton's line search is on the
    residual, and no stability is judged.  Pinned points stay at q0; what depends on time is taken at t.

    tol: bound on the largest |f| of a free coordinate, relative to the largest force that acts anywhere, supports
    included; what the positions' round-off makes of the stiffness counts as balanced.

    What is returned is always in balance.  Its status is `converged`, or `singular` at a fold or bifurcation, or
    `unstable`; of the last two nothing can be differentiated.
    Raises ValueError on bad input, and EquilibriumError, with the last place and its status, where no equilibrium
    exists or none was found; `dsim.gradients.quasistatic.record` returns that one too.

    >>> from dsim.effects import Gravity, Springs
    >>> system = System([1.0, 2.0], [Springs([(0, 1)], 1.0, 50.0), Gravity([0.0, -10.0])], dimension=2, fixed=[0])
    >>> rest = quasistatic(system, [0, 0, 1, 0])  # l0 + m g / k = 1.4 below the hook
    >>> rest.q.round(12).tolist()
    [0.0, 0.0, 0.0, -1.4]
    >>> rest.linearize().jacobian("springs.stiffness")[3].round(12).tolist()  # m g / k^2
    [0.008]
    """
    equilibrium = record(system, q0, t=t, tol=tol, max_iterations=max_iterations, kicks=kicks)
    if equilibrium.status not in (Status.CONVERGED, Status.SINGULAR, Status.UNSTABLE):
        raise EquilibriumError(explain(equilibrium), equilibrium)
    return equilibrium


def record(
    system: System, q0: Any, *, t: float = 0.0, tol: float = 1e-10, max_iterations: int = 500, kicks: int = 8
) -> Equilibrium:
    """`quasistatic`, but a search that fails is returned with its status instead of raising."""
    if not isinstance(system, System):
        raise ValueError(f"system must be a second-order System, whose forces balance; got {system!r:.60}")
    if system.curved:
        raise ValueError(
            "system must be one of points: the search adds positions, and those of rigid bodies do not add; let drag "
            "bring the bodies to rest, with BackwardEuler and long steps"
        )
    q = as_array("q0", q0, (system.n,))
    t, tol = float(as_array("t", t, ())), float(as_positive("tol", tol, ()))
    budget, kicks = as_count("max_iterations", max_iterations, least=1), as_count("kicks", kicks)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _search(StaticProblem(system, t, q), tol, budget, kicks)


def _search(problem: StaticProblem, tol: float, budget: int, kicks: int) -> Equilibrium:
    q, kicked, relative, mode = problem.q0.copy(), 0, np.nan, None
    while True:
        q, status, imbalance = problem.descend(q, tol, budget)
        if problem.conservative and not problem.silent_at(q):  # what did nothing at the start does something here
            problem.conservative = False
            continue
        if status is not Status.CONVERGED:
            break
        mode = problem.mode(q)
        status, relative = problem.judge(q, mode)
        place = problem.kick(q, mode) if status is Status.UNSTABLE and kicked < kicks else None
        if place is None:
            break
        q, kicked = place, kicked + 1
    q.setflags(write=False)
    factor = None if mode is None else mode.factor
    return Equilibrium(problem.system, problem.t, q, status, imbalance, relative, kicked, problem.counters, factor)


def explain(equilibrium: Equilibrium) -> str:
    """One line on a search that failed: its status, what that means, what to do."""
    small = f"the smallest relative eigenvalue of the stiffness is {equilibrium.eigenvalue:.1e}"
    advice = {
        Status.SINGULAR: f"a fold, a bifurcation or a free motion ({small}); nothing can be differentiated there",
        Status.UNSTABLE: f"not a minimum of the energy ({small}); allow more kicks or start elsewhere",
        Status.NO_EQUILIBRIUM: "the energy falls without end, or no zero of the force was found; is the body held, "
        "and can it bear the load?",
        Status.MAX_ITERATIONS: f"forces out of balance by {equilibrium.imbalance:.1e}; allow more max_iterations, "
        "a looser tol or start closer",
        Status.LINE_SEARCH_FAILED: "no step lowered the energy; is every effect's energy that of its force?",
        Status.NOT_FINITE: "a force or a stiffness is NaN or overflowed",
    }[equilibrium.status]
    return f"no equilibrium to go on with: {equilibrium.status}; {advice}"


class EquilibriumLinearization:
    """A = dR/dq, B = dR/dq0 and C = dR/dtheta of R(q; q0, theta) = (-f on free coordinates, q - q0 on pinned ones).

    `tangent` and `pullback` share one factorization of the free block; A, B and C are the definition.
    """

    def __init__(self, equilibrium: Equilibrium) -> None:
        self.system, self.t, self.q = equilibrium.system, equilibrium.t, equilibrium.q
        self._rest = np.zeros_like(self.q)
        self._kept = equilibrium.factor

    @cached_property
    def _factor(self) -> Factor:
        if self._kept is not None:
            return self._kept
        matrix, _, band = self.system.stiffness(self.t, self.q)
        return factorize(matrix, band)

    @cached_property
    def _partial(self) -> csr_array:
        """K = df/dq, pinned rows 0."""
        return self.system.stage_partials(self.t, self.q, self._rest)[0]

    @cached_property
    def _by_theta(self) -> csr_array:
        """df/dtheta, pinned rows 0."""
        return self.system.stage_dtheta(self.t, (self.q, self._rest), self._rest)

    def tangent(self, dtheta: Any, dq0: Any = None) -> Array:
        """dx* from dtheta (P,) -> (n,), or from k columns (P,k) -> (n,k) on one factorization.

        dq0 (n,) or (n,k): moves the pins; its entries at free coordinates do not count.
        """
        dtheta = _columns("dtheta", dtheta, self.system.parameter_count)
        load = self._by_theta @ dtheta
        if dq0 is None:
            return self._factor.solve(load)
        dq0 = _columns("dq0", dq0, self.system.n)
        if dq0.shape[1:] != dtheta.shape[1:]:
            raise ValueError(f"dq0 must have as many columns as dtheta; got shapes {dq0.shape} and {dtheta.shape}")
        pins = ((1 - self.system.free) * dq0.T).T
        return self._factor.solve(load + self._partial @ pins) + pins

    def jacobian(self, *names: str) -> Array:
        """dx*/dp (n,p), the columns of the named parameters one after another; of all of theta without a name."""
        parts = self.system.split(np.arange(float(self.system.parameter_count)))
        for name in names:
            if name not in parts:
                raise ValueError(f"no parameter is called {name!r}; this system has {', '.join(parts)}")
        places = np.concatenate([np.ravel(parts[name]) for name in names or parts]).astype(int)
        return self._factor.solve(self._by_theta[:, places].toarray())

    def pullback(self, mu: Array, theta_bar: Array) -> Array:
        """From mu = dO/dx* (n,): adds (dx*/dtheta)^T mu into theta_bar (P,), returns the gradient by q0 (n,).

        That one is 0 at free coordinates; at pinned ones it is the gradient by where they are pinned.
        """
        w = self._factor.solve_transposed(self.system.free * mu)
        by_q = self.system.stage_vjp(self.t, (self.q, self._rest), self._rest, w, theta_bar)[0]
        gradient: Array = (1 - self.system.free) * (mu + by_q)
        return gradient

    @property
    def A(self) -> csr_array:
        """dR/dq."""
        return self._pinned - self._partial

    @property
    def B(self) -> csr_array:
        """dR/dq0."""
        return -self._pinned

    @property
    def C(self) -> csr_array:
        """dR/dtheta."""
        return -self._by_theta

    @property
    def _pinned(self) -> csr_array:
        from dsim.arrays.scatter import diagonal

        return diagonal(1 - self.system.free)


def _columns(name: str, value: Any, rows: int) -> Array:
    array = as_array(name, value)
    if array.ndim not in (1, 2) or len(array) != rows:
        raise ValueError(f"{name} must have shape ({rows},) or ({rows}, k); got {array.shape}")
    return array


def _explicit(system: System, dOdtheta: Any) -> Array:
    """The explicit derivative by theta, a fresh array (P,)."""
    theta_bar = np.zeros(system.parameter_count)
    if not isinstance(dOdtheta, Mapping):
        return theta_bar if dOdtheta is None else as_array("dOdtheta", dOdtheta, theta_bar.shape).copy()
    parts = system.split(theta_bar)
    for name, value in dOdtheta.items():
        if name not in parts:
            raise ValueError(f"no parameter is called {name!r}; this system has {', '.join(parts)}")
        parts[name][...] = as_array(f"dOdtheta[{name!r}]", value, parts[name].shape)
    return theta_bar
