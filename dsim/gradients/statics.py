"""A system at rest: its force, its stiffness and its potential, descent to an equilibrium, and what to make of one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.solve.curvature import Mode, softest_mode
from dsim.solve.linear import (
    Factor,
    Matrix,
    SingularMatrixError,
    factorize,
    factorize_definite,
    make_definite,
    shifted_factor,
)
from dsim.solve.newton import NewtonResult, Status, newton
from dsim.steppers.stepper import Counters
from dsim.system import Stiffness, System

if TYPE_CHECKING:
    from dsim.solve.band import Band

_CORRECTION = 1e-10  # Newton's last correction, relative to the body's size
_FAR = 1e9  # sizes of the body: who has gone so far downhill has no equilibrium
_BESIDE = 1e-8  # of the largest entry: what is added to a singular matrix, for a direction only
_STUCK = 1e-2  # imbalance of a place where Newton ends far from balance: a planet's fall into its sun
_KICK = 0.1  # sizes of the body: the first step away from an unstable equilibrium

# A fold or bifurcation: the smallest eigenvalue is below SOFT of the largest, and grows more than tenfold within
# _PROBE sizes of the body along its mode.  The second half spares what is soft and no fold: a chain of 400 links
# (8.6e-7), a hanging cloth of 48 x 48 points (2.5e-7).
SOFT = 1e-6
_PROBE, _LASTING = 1e-3, 0.1
_LOST = 1e-10  # relative eigenvalues below this are singular whatever the neighbourhood looks like


class _RanAwayError(ArithmeticError):
    """The iterates left every bound."""


class Capped:
    """Solves with a factor; a correction longer than the limit keeps its direction only.  No factor: straight down."""

    def __init__(self, factor: Factor | None, limit: float) -> None:
        self.factor, self.limit = factor, limit

    def solve(self, b: Array) -> Array:
        x = b if self.factor is None else self.factor.solve(b)
        longest = np.abs(x).max(initial=0.0)
        return x * (self.limit / longest) if longest > self.limit or self.factor is None else x


class StaticProblem:
    """0 = f(t, q, 0) on the free degrees of freedom; the pinned ones stay where q0 has them.  Counts what it costs.

    A force whose derivative by q is structurally zero is constant at rest, so it has the potential -f.q; damping has
    no force at rest, so it has none.  With these the system is conservative where every other effect has an energy.
    """

    def __init__(self, system: System, t: float, q0: Array) -> None:
        self.system, self.t, self.q0 = system, t, q0
        self.rest = np.zeros(system.n)
        self.free = np.flatnonzero(system.free)
        self.counters = Counters()
        self._last: tuple[Array, Stiffness] | None = None
        bare = [effect for effect in system.effects if getattr(effect, "energy", None) is None]
        self.dead = sum((self._of(e, q0) for e in bare if getattr(e, "dq", None) is None), self.rest)
        self.silent = [effect for effect in bare if getattr(effect, "dq", None) is not None]
        self.conservative = self.silent_at(q0)

    def _of(self, effect: Any, q: Array) -> Array:
        force: Array = np.asarray(effect.force(self.t, q, self.rest), dtype=float)
        return force

    def silent_at(self, q: Array) -> bool:
        """Whether the effects that have a stiffness but no energy do nothing at rest here: damping does nothing."""
        place = (self.t, q, self.rest)
        return not any(self._of(e, q).any() or self.system.jacobian(e, "dq", place).data.any() for e in self.silent)

    # The three functions of position

    def residual(self, q: Array) -> Array:
        """-f, N, and 0 at pinned entries: the residual of a stage at the rate 0."""
        self.counters += Counters(forces=1)
        return self.system.stage_residual(self.rest, self.t, q, self.rest)

    def stiffness(self, q: Array) -> Stiffness:
        """-df/dq; the last one is kept."""
        if self._last is None or not np.array_equal(self._last[0], q):
            self.counters += Counters(jacobians=1)
            self._last = q.copy(), self.system.stiffness(self.t, q)
        return self._last[1]

    def potential(self, q: Array) -> float:
        """U, J, whose gradient is the residual."""
        return self.system.potential(self.t, q) - float(self.dead @ q)

    # Scales

    def size(self, q: Array) -> float:
        """The body's extent, m: the longest side of the box around its points; 1 where they are all in one place."""
        x = q.reshape(len(self.system.mass), -1)
        return float((x.max(axis=0) - x.min(axis=0)).max()) or 1.0

    def imbalance(self, q: Array, residual: Array) -> float:
        """The largest |f| of a free coordinate, relative to the largest force that acts anywhere, supports included.

        What the round-off of the positions makes of the stiffness counts as balanced.
        """
        forces = sum((np.abs(self._of(effect, q)) for effect in self.system.effects), self.rest)
        left = float(np.abs(residual).max(initial=0.0))
        noise = 16 * np.finfo(float).eps * self.stiffness(q).size * float(np.abs(q).max(initial=0.0))
        return 0.0 if left <= noise else left / max(float(forces.max(initial=0.0)), np.finfo(float).tiny)

    # Descent

    def direct(self, q: Array) -> Capped:
        """Newton's direction at q: of the energy with a matrix made definite, of the residual with the exact one."""
        size, gone = self.size(q), float(np.abs(q - self.q0).max(initial=0.0))
        if gone > _FAR * self.size(self.q0):
            raise _RanAwayError(f"{gone:.1e} m from the start")
        matrix, scale, band = self.stiffness(q)
        self.counters += Counters(factorizations=1, solves=1)
        if not self.conservative:
            return Capped(_factor_nearby(matrix, scale, band), size + gone)
        if scale == 0.0:  # no stiffness at all: straight downhill
            return Capped(None, size + gone)
        return Capped(factorize_definite(matrix, band), size + gone)

    def descend(self, q: Array, tol: float, max_iterations: int) -> tuple[Array, Status, float]:
        """Newton from q: the place, how it ended, and the imbalance there."""
        length = self.size(self.q0)
        try:
            result = newton(
                self.residual,
                self.direct,
                q,
                tol=_CORRECTION,
                globalize=self.potential if self.conservative else "line_search",
                max_iterations=max_iterations,
                size=lambda dq, q: float(np.abs(dq).max(initial=0.0)) / length,
            )
        except _RanAwayError:
            return q, Status.NO_EQUILIBRIUM, np.inf
        self.counters += Counters(newton_iterations=result.iterations)
        if not np.isfinite(result.residuals[-1]):
            return result.z, Status.NOT_FINITE, np.inf
        imbalance = self.imbalance(result.z, self.residual(result.z))
        return result.z, self._ending(result, imbalance, tol), imbalance

    def _ending(self, result: NewtonResult, imbalance: float, tol: float) -> Status:
        if imbalance <= tol:
            return Status.CONVERGED
        if result.converged and imbalance > _STUCK:
            return Status.NO_EQUILIBRIUM
        if result.status in (Status.SINGULAR, Status.LINE_SEARCH_FAILED):
            return Status.LINE_SEARCH_FAILED if self.conservative else Status.NO_EQUILIBRIUM
        return Status.MAX_ITERATIONS if result.converged else result.status

    # What the equilibrium is

    def mode(self, q: Array) -> Mode:
        """The softest mode of the stiffness."""
        matrix, size, band = self.stiffness(q)
        if size == 0.0 or not len(self.free):
            vector = np.zeros(len(q))
            vector[self.free[:1]] = 1.0
            return Mode(0.0, vector, vector, 1.0, None)
        self.counters += Counters(factorizations=1)
        return softest_mode(matrix, band, self.free, symmetric=self.conservative)

    def judge(self, q: Array, mode: Mode) -> tuple[Status, float]:
        """Converged, unstable or singular, and the mode's eigenvalue relative to the largest.

        Relative to the largest of the matrix, of what was added up in it, and of its neighbours': a matrix of one
        row has nothing else to be compared with.
        """
        if not len(self.free):
            return Status.CONVERGED, 1.0
        reach = _PROBE * self.size(q) * mode.right / np.abs(mode.right).max()
        here = self.stiffness(q)
        sides = self.stiffness(q + reach), self.stiffness(q - reach)
        largest = max(mode.largest, here.size, *(side.size for side in sides), np.finfo(float).tiny)
        relative = mode.value / largest
        if abs(relative) < SOFT and (abs(relative) < _LOST or not self._lasting(q, mode, here, sides, reach)):
            return Status.SINGULAR, relative
        return Status.UNSTABLE if self.conservative and relative < 0 else Status.CONVERGED, relative

    def _lasting(self, q: Array, mode: Mode, here: Stiffness, sides: tuple[Stiffness, Stiffness], reach: Array) -> bool:
        """Whether the curvature along the mode stays within ten times its value on the curve q +- s + w/2, s the reach.

        K w = -dK[s] s, but for the mode itself: what is stiff gives way on the curve as it does in a motion along it.
        """
        bend = 0.5 * (sides[0].matrix @ reach - sides[1].matrix @ reach)
        bend -= mode.left * (mode.left @ bend)
        try:
            w = -self._solve_beside(here, bend)
        except SingularMatrixError:
            return False
        w -= mode.right * (mode.right @ w)
        largest = 0.0
        for sign in (1.0, -1.0):
            tangent = reach + sign * w
            left = tangent if self.conservative else mode.left
            there = self.stiffness(q + sign * reach + 0.5 * w).matrix
            curvature = left @ (there @ tangent) / (np.linalg.norm(left) * np.linalg.norm(tangent))
            largest = max(largest, abs(float(curvature)))
        return bool(_LASTING * largest <= abs(mode.value))

    def _solve_beside(self, stiffness: Stiffness, b: Array) -> Array:
        """K w = b for b without a part along the soft mode; a matrix that is not definite is shifted a little."""
        matrix, size, band = stiffness
        if not self.conservative:
            return factorize(matrix, band).solve(b)
        if isinstance(matrix, np.ndarray):
            return factorize(make_definite(matrix)).solve(b)
        return shifted_factor(matrix, band, np.full(len(b), size), 1e-8)[0].solve(b)

    def kick(self, q: Array, mode: Mode) -> Array | None:
        """Down from a stationary point along a direction of negative curvature; None if no length lowers the energy."""
        direction, height = mode.right / np.abs(mode.right).max(), self.potential(q)
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])  # the same on every machine
        length = _KICK * self.size(q)
        while length > 1e-8 * self.size(q):
            tried = [(self.potential(place), place) for place in (q + length * direction, q - length * direction)]
            lowest, place = min(tried, key=lambda pair: pair[0])
            if lowest < height + 0.25 * mode.value * length**2 * float(direction @ direction):
                return place
            length /= 2
        return None


def _factor_nearby(matrix: Matrix, size: float, band: Band | None) -> Factor:
    """The factor of the matrix, or of one a little beside it where it is singular.  Raises SingularMatrixError."""
    try:
        return factorize(matrix, band)
    except SingularMatrixError:
        return factorize(matrix + _BESIDE * size * _identity_like(matrix))


def _identity_like(matrix: Matrix) -> Matrix:
    if isinstance(matrix, np.ndarray):
        return np.eye(len(matrix))
    from dsim.arrays.scatter import diagonal

    return diagonal(np.ones(matrix.shape[0]))
