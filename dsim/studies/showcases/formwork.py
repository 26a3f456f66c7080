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
from dsim.gradients.quasistatic import Equilibrium, record
from dsim.scenes.nets import lattice
from dsim.solve.newton import Status
from dsim.studies.check import Check
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
    pinned = (np.abs(x) > SPAN / 2 - spacing / 2).any(axis=1)
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

    `residual` and `jacobian` are for least_squares, `value_and_gradient` is for minimize(jac=True).
    """

    def __init__(self, fabric: Fabric, target: Target) -> None:
        self.fabric, self.target = fabric, target
        parts = fabric.system.split(fabric.system.theta)
        self.rest, self.stiffness = parts["springs.rest_length"], parts["springs.stiffness"]
        self.searches = 0
        self._last: tuple[Array, Equilibrium] | None = None
        self._start: Array = fabric.flat.ravel()

    @property
    def bounds(self) -> tuple[Array, Array]:
        half = np.repeat([REST_RANGE / 0.1, np.log10(STIFFNESS_RANGE)], len(self.rest))
        return -half, half

    def parameters(self, z: Array) -> tuple[Array, Array]:
        """Rest lengths and stiffnesses, (E,) each."""
        by_rest, by_stiffness = np.split(z, 2)
        return self.rest * (1 + 0.1 * by_rest), self.stiffness * 10.0**by_stiffness

    def equilibrium(self, z: Array) -> Equilibrium:
        """Where the fabric hangs; the last one is kept."""
        if self._last is None or not np.array_equal(self._last[0], z):
            rest, stiffness = self.parameters(z)
            system = self.fabric.system
            theta = system.join(**{"springs.rest_length": rest, "springs.stiffness": stiffness})
            found = record(system.with_theta(theta), self._start)
            self.searches += 1
            self._last = np.array(z), found
            if found.status is Status.CONVERGED:
                self._start = found.q
        return self._last[1]

    def distance(self, found: Equilibrium) -> Array:
        """Distance of every free point from the target, (N,) m."""
        distance: Array = np.linalg.norm(self.target.gap(self._inner(found.q)), axis=1)
        return distance

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

    def residual(self, z: Array) -> Array:
        """What is squared and summed, (k N + E + 2E,); infinite where the fabric does not hang."""
        found = self.equilibrium(z)
        far, slack, plain = self._weights
        gap = far * self.target.gap(self._inner(found.q)).ravel()
        if found.status is not Status.CONVERGED:
            return np.full(gap.size + 3 * len(self.rest), np.inf)
        return np.concatenate([gap, slack * np.minimum(0.0, self.strain(found) - _TAUT), plain * z])

    def partials(self, z: Array) -> tuple[csr_array, csr_array]:
        """The residual's derivatives by positions (k N + 3E, n) at fixed z, and by z (k N + 3E, 2E) at fixed positions."""
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
        residual = self.residual(z)
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
class FormworkResult:
    """The uniform fabric and the designed one.  history: the root mean square distance at every equilibrium on the
    way, relative to the span."""

    problem: FormworkProblem
    before: Equilibrium
    after: Equilibrium
    z: Array
    history: Array
    evaluations: int
    message: str

    def rms(self, found: Equilibrium) -> float:
        """Root mean square distance from the target, relative to the span."""
        return float(np.sqrt(np.mean(self.problem.distance(found) ** 2))) / SPAN

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

    @property
    def checks(self) -> tuple[Check, ...]:
        """What success is made of."""
        low, high = self.problem.bounds
        inside = bool((self.z >= low).all() and (self.z <= high).all())
        rms, slackest = self.rms(self.after), float(self.problem.strain(self.after).min())
        converged = self.after.status is Status.CONVERGED
        return (
            Check("formwork", "RMS distance from the target / span", rms <= REACHED, rms, f"<= {REACHED:g}"),
            Check("formwork", "smallest strain of a thread", slackest >= 0.0, slackest, ">= 0"),
            Check("formwork", "unknowns within their bounds", inside, float(inside), "= 1"),
            Check("formwork", "largest force left / a point's weight", self.imbalance <= 1e-8, self.imbalance, "<= 1e-08"),
            Check("formwork", "a stable equilibrium", converged, float(converged), "= 1"),
        )

    @property
    def ok(self) -> bool:
        return all(check.passed for check in self.checks)


def formwork(
    n: int = 21, evaluations: int = 60, target: Target | None = None, progress: Callable[[str], None] | None = None
) -> FormworkResult:
    """Design an n x n fabric for a target (two bellies by default) within so many equilibria, by Gauss-Newton.

    n = 21 has 1083 degrees of freedom and 3112 unknowns and takes some fifteen seconds; n = 9 with 25 equilibria takes
    two.  progress: told a line every fifth equilibrium.  Raises ValueError on bad input.
    """
    from scipy.optimize import least_squares

    evaluations = as_count("evaluations", evaluations, least=1)
    problem = FormworkProblem(fabric(n), target or TwoBellies())
    z = np.zeros(2 * len(problem.rest))
    before, history = problem.equilibrium(z), list[float]()

    def residual(z: Array) -> Array:
        value = problem.residual(z)
        distance = float(np.sqrt(np.mean(problem.distance(problem.equilibrium(z)) ** 2))) / SPAN
        history.append(distance if np.isfinite(value).all() else np.nan)
        if progress is not None and len(history) % 5 == 0:
            progress(f"equilibrium {len(history)}: {distance:.1e} of the span from the target")
        return value

    options: dict[str, Any] = {"tr_solver": "lsmr", "max_nfev": evaluations, "xtol": 1e-10, "ftol": 1e-10}
    found = least_squares(residual, z, jac=problem.jacobian, bounds=problem.bounds, **options)
    after = problem.equilibrium(found.x)
    return FormworkResult(problem, before, after, found.x, np.array(history), problem.searches, str(found.message))
