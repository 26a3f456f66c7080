"""Inverse design of fabric formwork: rest lengths and stiffnesses for which a membrane full of wet concrete hangs in a
wanted shape.  Lecture: "Differentiable simulation"; the idea is that of Zhang et al., "Computational Design of Fabric
Formwork", SIGGRAPH 2019.

The unknowns are one rest length and one stiffness a thread.  The objective O(x*, p) is half a sum of squares:

    distance      of every free point from the target, in thousandths of the span,
    slackness     of every thread that is less stretched than 1 %: a slack fabric wrinkles,
    plainness     a weak pull of every unknown to its start, since many fabrics hang in one shape.

Its derivative needs dx*/dp in both directions, which is all that an equilibrium's linearization offers: Gauss-Newton
(`scipy.optimize.least_squares`) multiplies with the Jacobian by tangents and with its transpose by pullbacks, on one
factorization an equilibrium.  While all threads are taut the energy is convex, so that the equilibrium does not depend
on where its search starts; it starts from the last one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, as_count
from dsim.effects import Gravity, Springs
from dsim.gradients.optimisation import Optimisation, optimise
from dsim.gradients.quasistatic import Equilibrium, record
from dsim.scenes.nets import lattice
from dsim.solve.newton import Status
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import at_least, at_most, equal
from dsim.studies.showcases.model import Report, slope_error
from dsim.system import System

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import LinearOperator

SPAN = 2.0  # m, of the square frame
LOAD = 120.0  # kg/m^2: 5 cm of wet concrete
THREAD, DIAGONAL = 5e3, 1e3  # N/m at the start
PRESTRAIN = 0.9  # rest length over spacing at the start
REST_RANGE, STIFFNESS_RANGE = 0.15, 10.0  # rest lengths to +-15 %, stiffnesses to a tenth and ten times the start's
REACHED = 1e-3  # of the span: the root mean square distance that is promised
_TAUT = 1e-2  # strain below which a thread counts as slack
_WEIGHT, _PLAIN = 3.0, 0.1  # of a thread's slackness in units of that strain, of an unknown's distance from its start


class Target(Protocol):
    """A shape to hang in."""

    def gap(self, x: Array) -> Array:
        """How far points x (N,3) are off: (N,k) m."""
        ...

    def slope(self, x: Array) -> Array:
        """dgap/dx (N,k,3)."""
        ...


@dataclass(frozen=True)
class TwoBellies:
    """z = -(1 - x^2)(1 - y^2)(a - b cos(pi x) + c y) m on the frame |x|, |y| <= 1 m: two bellies, one deeper than the
    other.  The gap is the vertical distance: points may slide along the surface."""

    depth: float = 0.27
    ridge: float = 0.11
    tilt: float = 0.05

    def height(self, x: Array, y: Array) -> Array:
        z: Array = -(1 - x**2) * (1 - y**2) * self._depth(x, y)
        return z

    def _depth(self, x: Array, y: Array) -> Array:
        depth: Array = self.depth - self.ridge * np.cos(np.pi * x) + self.tilt * y
        return depth

    def gap(self, x: Array) -> Array:
        return (x[:, 2] - self.height(x[:, 0], x[:, 1]))[:, None]

    def slope(self, x: Array) -> Array:
        u, v, depth = x[:, 0], x[:, 1], self._depth(x[:, 0], x[:, 1])
        by_x = (1 - v**2) * (2 * u * depth - (1 - u**2) * np.pi * self.ridge * np.sin(np.pi * u))
        by_y = (1 - u**2) * (2 * v * depth - (1 - v**2) * self.tilt)
        return np.stack([-by_x, -by_y, np.ones_like(u)], axis=1)[:, None, :]


@dataclass(frozen=True, eq=False)
class Places:
    """Given places (N,3) of the free points, such as a known fabric's: the gap is the whole difference."""

    places: Array

    def gap(self, x: Array) -> Array:
        return x - self.places

    def slope(self, x: Array) -> Array:
        return np.broadcast_to(np.eye(3), (len(x), 3, 3))


@dataclass(frozen=True, eq=False)
class Fabric:
    """n x n points on a square frame to which the outermost are pinned, flat at first.  edges (E,2), inner: the free
    points; flat (n^2,3) m."""

    n: int
    system: System
    flat: Array
    edges: NDArray[np.int64]
    inner: NDArray[np.int64]

    @property
    def unknowns(self) -> tuple[int, int]:
        """Degrees of freedom, and parameters to be found."""
        return 3 * len(self.inner), 2 * len(self.edges)


def fabric(n: int) -> Fabric:
    """The uniform fabric.  Threads along both directions and both diagonals; none lies on the frame."""
    n = as_count("n", n, least=3)
    spacing = SPAN / (n - 1)
    x, threads, diagonals = lattice((n, n), spacing)
    x -= SPAN / 2
    pinned = np.abs(x).max(axis=1) > SPAN / 2 - spacing / 2
    edges = np.concatenate([threads, diagonals])
    stiffness = np.repeat([THREAD, DIAGONAL], [len(threads), len(diagonals)])
    free = ~pinned[edges].all(axis=1)
    edges, stiffness = edges[free], stiffness[free]
    rest = PRESTRAIN * np.linalg.norm(x[edges[:, 1]] - x[edges[:, 0]], axis=1)
    effects = [Gravity([0.0, 0.0, -9.81]), Springs(edges, rest, stiffness)]
    system = System(np.full(n * n, LOAD * spacing**2), effects, dimension=3, fixed=np.flatnonzero(pinned))
    return Fabric(n, system, np.column_stack([x, np.zeros(n * n)]), edges, np.flatnonzero(~pinned))


class FormworkProblem:
    """O as a function of the unknowns z (2E,): rest = rest_0 (1 + 0.1 z), stiffness = stiffness_0 10^z.

    Itself and `jacobian` are for least_squares, `value_and_gradient` is for minimize(jac=True).
    """

    def __init__(self, fabric: Fabric, target: Target) -> None:
        self.fabric, self.target = fabric, target
        parts = fabric.system.split(fabric.system.theta)
        self.rest, self.stiffness = parts["springs.rest_length"], parts["springs.stiffness"]
        self._start: Array = fabric.flat.ravel()
        self._at, self.last = np.full(2 * len(self.rest), np.nan), record(fabric.system, self._start)

    @property
    def bounds(self) -> tuple[Array, Array]:
        half = np.repeat([REST_RANGE / 0.1, np.log10(STIFFNESS_RANGE)], len(self.rest))
        return -half, half

    def parameters(self, z: Array) -> tuple[Array, Array]:
        """Rest lengths and stiffnesses, (E,) each."""
        by_rest, by_stiffness = np.split(z, 2)
        return self.rest * (1 + 0.1 * by_rest), self.stiffness * 10.0**by_stiffness

    def equilibrium(self, z: Array) -> Equilibrium:
        """Where the fabric hangs; `last` is kept."""
        if not np.array_equal(self._at, z):
            rest, stiffness = self.parameters(z)
            system = self.fabric.system
            theta = system.join(**{"springs.rest_length": rest, "springs.stiffness": stiffness})
            self._at, self.last = np.array(z), record(system.with_theta(theta), self._start)
            if self.last.status is Status.CONVERGED:
                self._start = self.last.q
        return self.last

    def distance(self, found: Equilibrium) -> Array:
        """Distance of every free point from the target, (N,) m."""
        distance: Array = np.linalg.norm(self.target.gap(self._inner(found.q)), axis=1)
        return distance

    def rms(self, found: Equilibrium) -> float:
        """Root mean square distance from the target, relative to the span; NaN without an equilibrium."""
        if found.status is not Status.CONVERGED:
            return np.nan
        return float(np.sqrt(np.mean(self.distance(found) ** 2))) / SPAN

    def _inner(self, q: Array) -> Array:
        x: Array = q.reshape(-1, 3)[self.fabric.inner]
        return x

    def strain(self, found: Equilibrium) -> Array:
        """l/l0 - 1 of every thread (E,)."""
        strain: Array = np.linalg.norm(self._along(found.q), axis=1) / _rest(found) - 1
        return strain

    def _along(self, q: Array) -> Array:
        x = q.reshape(-1, 3)
        edge: Array = x[self.fabric.edges[:, 1]] - x[self.fabric.edges[:, 0]]
        return edge

    @property
    def _weights(self) -> tuple[float, float, float]:
        """Of a metre of distance, of a unit of slackness, and of plainness."""
        points, threads = len(self.fabric.inner), len(self.rest)
        return 1e3 / (SPAN * np.sqrt(points)), _WEIGHT / (_TAUT * np.sqrt(threads)), _PLAIN / np.sqrt(2 * threads)

    def __call__(self, z: Array) -> Array:
        """What is squared and summed, (k N + E + 2E,); infinite where the fabric does not hang."""
        found = self.equilibrium(z)
        far, slack, plain = self._weights
        gap = far * self.target.gap(self._inner(found.q)).ravel()
        if found.status is not Status.CONVERGED:
            return np.full(gap.size + 3 * len(self.rest), np.inf)
        return np.concatenate([gap, slack * np.minimum(0.0, self.strain(found) - _TAUT), plain * z])

    def partials(self, z: Array) -> tuple[csr_array, csr_array]:
        """The residual's derivatives by positions (k N + 3E, n), and by z at fixed positions (k N + 3E, 2E)."""
        from scipy.sparse import csr_array, diags_array, vstack

        found, (far, slack, plain) = self.equilibrium(z), self._weights
        edge, rest, threads = self._along(found.q), self.parameters(z)[0], np.arange(len(self.rest))
        length = np.linalg.norm(edge, axis=1)
        weight = slack * (length / rest - 1 < _TAUT)
        pull = (weight / (rest * length))[:, None] * edge
        gaps = _rows(far * self.target.slope(self._inner(found.q)), self.fabric.inner, len(found.q))
        ends = [_rows(sign * pull[:, None, :], self.fabric.edges[:, i], len(found.q)) for i, sign in ((0, -1), (1, 1))]
        shape = (len(rest), len(z))
        by_rest = csr_array((-weight * length / rest**2 * 0.1 * self.rest, (threads, threads)), shape=shape)
        by_q = vstack([gaps, ends[0] + ends[1], csr_array((len(z), len(found.q)))])
        by_z = vstack([csr_array((gaps.shape[0], len(z))), by_rest, plain * diags_array(np.ones(len(z)))])
        return csr_array(by_q), csr_array(by_z)

    def spread(self, z: Array) -> csr_array:
        """dtheta/dz (P,2E): which entries of theta the unknowns are, and their scales."""
        from scipy.sparse import csr_array

        system, unknowns = self.fabric.system, np.arange(len(z))
        places = system.split(np.arange(float(system.parameter_count)))
        rows = np.concatenate([places["springs.rest_length"], places["springs.stiffness"]]).astype(int)
        scales = np.concatenate([0.1 * self.rest, np.log(10) * self.parameters(z)[1]])
        return csr_array((scales, (rows, unknowns)), shape=(system.parameter_count, len(z)))

    def jacobian(self, z: Array) -> LinearOperator:
        """dresidual/dz = dr/dx* dx*/dz + dr/dz, as products: a tangent of the equilibrium, or a pullback."""
        from scipy.sparse.linalg import LinearOperator

        (by_q, by_z), spread = self.partials(z), self.spread(z)
        from_q, from_z, gather = by_q.T.tocsr(), by_z.T.tocsr(), spread.T.tocsr()
        linearization = self.equilibrium(z).linearize()

        def forward(dz: Array) -> Array:
            dz = np.ravel(dz)
            product: Array = by_q @ linearization.tangent(spread @ dz) + by_z @ dz
            return product

        def transposed(w: Array) -> Array:
            theta_bar = np.zeros(spread.shape[0])
            linearization.pullback(from_q @ np.ravel(w), theta_bar)
            product: Array = gather @ theta_bar + from_z @ np.ravel(w)
            return product

        return LinearOperator(by_z.shape, matvec=forward, rmatvec=transposed, dtype=float)

    def value_and_gradient(self, z: Array) -> tuple[float, Array]:
        """O, and dO/dz by the adjoint: one solve however many unknowns there are."""
        residual = self(z)
        return 0.5 * float(residual @ residual), self.jacobian(z).rmatvec(residual)


def _rows(blocks: Array, points: NDArray[np.int64], size: int) -> csr_array:
    """Rows (K k, size) whose blocks (K,k,3) stand at the coordinates of one point each."""
    from scipy.sparse import csr_array

    columns = np.repeat(3 * points[:, None] + np.arange(3), blocks.shape[1], axis=0)
    rows = np.repeat(np.arange(columns.shape[0]), 3)
    return csr_array((blocks.ravel(), (rows, columns.ravel())), shape=(columns.shape[0], size))


def _rest(found: Equilibrium) -> Array:
    """The rest lengths of an equilibrium's own system, (E,)."""
    return found.system.split(found.system.theta)["springs.rest_length"]


@dataclass(frozen=True, eq=False)
class Formwork:
    """The uniform fabric and the designed one.  distances: the root mean square distance at every equilibrium on the
    way, relative to the span; NaN where the fabric found no rest.  slope: relative error of the gradient at the start.
    """

    problem: FormworkProblem
    before: Equilibrium
    after: Equilibrium
    distances: Array
    optimisation: Optimisation
    slope: float

    def rms(self, found: Equilibrium) -> float:
        """Root mean square distance from the target, relative to the span."""
        return self.problem.rms(found)

    @property
    def z(self) -> Array:
        """The unknowns that were found (2E,)."""
        return self.optimisation.p

    @property
    def imbalance(self) -> float:
        """The largest force left on a free coordinate, relative to a point's weight."""
        system, q = self.after.system, self.after.q
        force = system.free * system.force(0.0, q, np.zeros_like(q))
        return float(np.abs(force).max() / (system.mass.max() * 9.81))

    @property
    def at_bounds(self) -> int:
        """How many unknowns ended within a thousandth of a bound."""
        low, high = self.problem.bounds
        return int(((self.z < low + 1e-3) | (self.z > high - 1e-3)).sum())

    def checks(self) -> tuple[Check, ...]:
        """What success is made of."""
        low, high = self.problem.bounds
        outside = float(np.maximum(low - self.z, self.z - high).max())
        stable = float(self.after.status is Status.CONVERGED)
        return (
            at_least("formwork", "RMS distance / span, uniform", self.rms(self.before), 20 * REACHED),
            at_most("formwork", "gradient against a difference", self.slope, 1e-5),
            at_most("formwork", "RMS distance / span, designed", self.rms(self.after), REACHED),
            at_least("formwork", "smallest strain of a thread", float(self.problem.strain(self.after).min()), 0.0),
            at_most("formwork", "an unknown beyond its bound", outside, 0.0),
            at_most("formwork", "force left / a point's weight", self.imbalance, 1e-8),
            equal("formwork", "a stable equilibrium", stable, 1),
        )


def run(quick: bool, report: Report | None = None) -> Formwork:
    """quick: 7 x 7 points, 16 equilibria.  In full: 21 x 21 points, 1083 degrees of freedom, 3112 unknowns, 60."""
    return formwork(7, 16, report=report) if quick else formwork(21, 60, report=report)


def formwork(
    n: int,
    evaluations: int,
    target: Target | None = None,
    report: Report | None = None,
    problem: Callable[[Fabric, Target], FormworkProblem] = FormworkProblem,
) -> Formwork:
    """Design an n x n fabric for a target (two bellies by default) within so many equilibria, by Gauss-Newton.

    report: told (equilibrium, evaluations, what).  problem: another one, for tests.  Raises ValueError on bad input.
    """
    evaluations = as_count("evaluations", evaluations, least=1)
    task = problem(fabric(n), target or TwoBellies())
    start, distances = np.zeros(2 * len(task.rest)), list[float]()
    before = task.equilibrium(start)
    slope = slope_error(task.value_and_gradient, start)

    def note(evaluation: int, value: float, _: float) -> None:
        distances.append(task.rms(task.last))
        if report is not None:
            report(min(evaluation, evaluations), evaluations, f"{distances[-1]:.1e} of the span off")

    options: dict[str, Any] = {"tr_solver": "lsmr", "x_scale": 1.0, "xtol": 1e-10, "ftol": 1e-10}
    found = optimise(task, start, report=note, bounds=task.bounds, max_nfev=evaluations, **options)
    return Formwork(task, before, task.equilibrium(found.p), np.array(distances), found, slope)
