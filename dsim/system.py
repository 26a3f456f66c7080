"""What is simulated: second-order systems of points under effects, and first-order flows.

Both offer the steppers the same few operations on a *stage*, the place where a rate is evaluated:
`rate` k, the implicit stage's residual and matrix, and the products with its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dsim.arrays.checks import Array, Numbers, as_array, as_count, as_positive
from dsim.arrays.differences import change_of_jacobian, change_of_slopes
from dsim.arrays.frozen import replace
from dsim.arrays.scatter import diagonal
from dsim.effects.curvature import curvature_of, is_differenced
from dsim.effects.effect import Effect, current
from dsim.effects.rows import products
from dsim.solve.linear import DENSE_SIZE
from dsim.solve.patterns import SumPattern

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from dsim.solve.band import Band


class _Parameter(NamedTuple):
    """Where one parameter of an effect lies: in the effect's own flat vector, and in the system's theta."""

    label: str
    shape: tuple[int, ...]
    own: slice
    place: slice


class Stiffness(NamedTuple):
    """-df/dq (n,n), N/m: dense where a dense factorization is quicker, else CSR, with its band if it has one.

    size: the sum of the effects' largest entries.  Where they cancel, the matrix itself does not show it.  Pinned
    rows and columns hold the size on the diagonal.
    """

    matrix: Any
    size: float
    band: Band | None


@dataclass(frozen=True, eq=False)
class System:
    """Points of mass m under effects:  dq/dt = v,  M dv/dt = f(t, q, v).  Lecture: "Particle system".

    mass (N,) kg > 0.  effects: force objects with different names.  fixed: indices of pinned points, which stay
    in y = [q, v] and do not move: their velocity counts as 0 whatever y says.  Raises ValueError on bad input.
    """

    mass: Numbers
    effects: Any = ()  # stored as a tuple of bound effects
    dimension: int = 3
    fixed: Any = ()  # stored as a tuple of indices
    layout: tuple[tuple[_Parameter, ...], ...] = field(default=(), repr=False)  # one entry an effect
    free: Array = field(default_factory=lambda: np.empty(0), repr=False)  # (n,) 1, and 0 at pinned entries
    patterns: dict[tuple[Any, ...], SumPattern] = field(default_factory=dict, init=False, repr=False)  # of matrices

    def __post_init__(self) -> None:
        mass = as_positive("mass", self.mass, (None,))
        dimension = as_count("dimension", self.dimension, least=1)
        if not len(mass):
            raise ValueError("mass must have at least one point; got shape (0,)")
        fixed = as_fixed(self.fixed, len(mass))
        effects = tuple(_bound(effect, mass, dimension) for effect in as_effects(self.effects))
        free = np.ones((len(mass), dimension))
        free[list(fixed)] = 0.0
        values = {
            "mass": mass,
            "dimension": dimension,
            "fixed": fixed,
            "effects": effects,
            "free": free.ravel(),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "layout", layout_of(self.own, effects))

    # Sizes and states

    components = 2  # a state is (q, v)
    curved = False  # positions add; those of rigid bodies do not
    OF_MASS: ClassVar[tuple[str, ...]] = ("masses",)  # cached properties that change with the system's own parameters

    @property
    def n(self) -> int:
        """Degrees of freedom, N d."""
        return len(self.mass) * self.dimension

    @property
    def width(self) -> int:
        """Length of q."""
        return self.n

    @property
    def size(self) -> int:
        """Length of y = [q, v]."""
        return self.width + self.n

    def blocks(self, y: Array) -> tuple[Array, Array]:
        """y (2n,) -> q and v (n,), the velocity of pinned points taken as 0; y (2n,k) in the same way."""
        return y[: self.width], (y[self.width :].T * self.free).T

    @cached_property
    def masses(self) -> Array:
        """The mass of every degree of freedom, (n,), read-only."""
        masses = np.repeat(self.mass, self.dimension)
        masses.setflags(write=False)
        return masses

    def check_start(self, y0: Array) -> None:
        """Raises ValueError for a state that is none."""

    # Parameters

    @cached_property
    def theta(self) -> Array:
        """Every differentiable parameter, flat (P,): mass first, then the effects' in their order."""
        theta = np.empty(self.parameter_count)
        for name, place in self.own.items():
            theta[place] = np.ravel(getattr(self, name))
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            for p in parameters:
                theta[p.place] = np.ravel(getattr(effect, p.label))
        theta.setflags(write=False)
        return theta

    @property
    def parameter_count(self) -> int:
        """P."""
        own = (place.stop for place in self.own.values())
        return max([*own, *(p.place.stop for parameters in self.layout for p in parameters)])

    @property
    def own(self) -> dict[str, slice]:
        """The parameters of the system itself, and their places in theta."""
        return {"mass": slice(0, len(self.mass))}

    def split(self, theta: Array) -> dict[str, Array]:
        """theta (P,) -> {"mass": (N,), "springs.stiffness": (E,), ...}; gradients split the same way."""
        theta = np.asarray(theta)
        if theta.shape != (self.parameter_count,):
            raise ValueError(f"theta must have shape ({self.parameter_count},); got {theta.shape}")
        parts = {name: theta[place].reshape(np.shape(getattr(self, name))) for name, place in self.own.items()}
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            named = (p for p in parameters if p.label not in parts)
            parts.update({f"{effect.name}.{p.label}": theta[p.place].reshape(p.shape) for p in named})
        return parts

    def join(self, **parts: Any) -> Array:
        """theta with some parts exchanged: join(**{"springs.stiffness": k}).  Unknown names raise KeyError's kin."""
        theta = self.theta.copy()
        views = self.split(theta)
        for name, value in parts.items():
            if name not in views:
                raise ValueError(f"no parameter is called {name!r}; this system has {', '.join(views)}")
            views[name][...] = as_array(name, value, views[name].shape)
        return theta

    def with_theta(self, theta: Array) -> System:
        """The same system with other parameter values; patterns are kept.

        Only shapes and finiteness are checked: a finite difference at stiffness 0 may step below it.
        """
        theta = as_array("theta", theta, (self.parameter_count,))
        own = {name: theta[place].reshape(np.shape(getattr(self, name))) for name, place in self.own.items()}
        effects = []
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            values = {p.label: theta[p.place].reshape(p.shape) for p in parameters}
            exchanged = getattr(effect, "exchanged", None) or partial(replace, effect)
            effects.append(exchanged(**values) if values else effect)
        return fresh(self, **own, effects=tuple(effects))

    def without(self, *names: str) -> System:
        """The system with some effects left out.  Raises ValueError for a name it does not have."""
        known = [effect.name for effect in self.effects]
        for name in names:
            if name not in known:
                raise ValueError(f"no effect is called {name!r}; this system has {', '.join(known) or 'none'}")
        rest = tuple(effect for effect in self.effects if effect.name not in names)
        return System(self.mass, rest, self.dimension, self.fixed)

    def at(self, t: float, y: Array, h: float) -> System:
        """The system of one step: every effect with discrete choices makes them here."""
        if not any(hasattr(effect, "at") for effect in self.effects):
            return self
        q = y[: self.width]
        return fresh(self, effects=tuple(e.at(t, q, h) if hasattr(e, "at") else e for e in self.effects))

    # Forces and their derivatives: sums over exactly the effects that have the capability

    def having(self, capability: str) -> tuple[Effect, ...]:
        """The effects with a capability (an attribute that is there and not None)."""
        return tuple(effect for effect in self.effects if getattr(effect, capability, None) is not None)

    def force(self, t: float, q: Array, v: Array) -> Array:
        """f (n,) N, the sum over all effects (pinned points included: their sum is the pins' load)."""
        total = np.zeros(self.n)
        for effect in self.effects:
            force = effect.force(t, q, v)
            if np.shape(force) != total.shape:
                raise ValueError(f"force of {effect.name!r} must return shape {total.shape}; got {np.shape(force)}")
            total += force
        return total

    @property
    def conservative(self) -> bool:
        """Whether every effect has an energy, so that f = -dU/dq."""
        return len(self.having("energy")) == len(self.effects)

    def potential(self, t: float, q: Array) -> float:
        """U, J: the sum over the effects that have an energy."""
        return float(sum(effect.energy(t, q) for effect in self.having("energy")))  # type: ignore[attr-defined]

    def kinetic(self, v: Array) -> float:
        """v^T M v / 2, J."""
        return 0.5 * float(v @ self.momentum(v))

    def energy(self, t: float, y: Array) -> float:
        """Kinetic plus potential energy, J."""
        q, v = self.blocks(y)
        return self.kinetic(v) + self.potential(t, q)

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        """K = df/dq, CSR (n,n)."""
        return self._sum("dq", t, q, v)

    def dv(self, t: float, q: Array, v: Array) -> csr_array:
        """D = df/dv, CSR (n,n)."""
        return self._sum("dv", t, q, v)

    def _sum(self, capability: str, *place: Any) -> csr_array:
        from scipy.sparse import csr_array

        total = csr_array((self.n, self.n))
        for effect in self.having(capability):
            total = total + self.jacobian(effect, capability, place)
        return csr_array(total)

    def dense(self, capability: str, t: float, q: Array, v: Array) -> Array:
        """`dq` or `dv` as an array (n,n), for few degrees of freedom: without a sparse matrix between."""
        total = np.zeros((self.n, self.n))
        for effect in self.having(capability):
            matrix = getattr(effect, capability)(t, q, v)
            self._check_square(effect, capability, matrix)
            total += matrix if isinstance(matrix, np.ndarray) else matrix.toarray()
        return total

    def _check_square(self, effect: Any, capability: str, matrix: Any) -> None:
        if np.shape(matrix) != (self.n, self.n):
            shape = (self.n, self.n)
            raise ValueError(f"{capability} of {effect.name!r} must return shape {shape}; got {np.shape(matrix)}")

    def jacobian(self, effect: Any, capability: str, place: tuple[Any, ...]) -> csr_array:
        """An effect's dq or dv as CSR, whatever it came as; ValueError for another shape."""
        matrix = getattr(effect, capability)(*place)
        self._check_square(effect, capability, matrix)
        if getattr(matrix, "format", "") == "csr":
            return matrix
        from scipy.sparse import csr_array

        return csr_array(matrix)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        """df/dtheta, CSR (n,P)."""
        from scipy.sparse import coo_array, csr_array

        total = csr_array((self.n, self.parameter_count))
        for effect, places in self._differentiable():
            local = coo_array(effect.dtheta(t, q, v))
            entries = (local.data, (local.row, places[local.col]))
            total = total + csr_array(entries, shape=total.shape)
        return csr_array(total)

    def _differentiable(self) -> Iterable[tuple[Any, NDArray[np.int64]]]:
        """Effects with dtheta, and the place in theta of each of its columns."""
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            if not parameters or getattr(effect, "dtheta", None) is None:
                continue
            window = getattr(effect, "columns", slice(None))
            if window.start is None:
                yield effect, np.concatenate([np.arange(p.place.start, p.place.stop) for p in parameters])
            else:  # a window, for an effect with a single parameter
                yield effect, parameters[0].place.start + np.arange(window.start, window.stop)

    def vjp(self, t: float, q: Array, v: Array, w: Array, theta_bar: Array) -> tuple[Array, Array]:
        """(K^T w, D^T w); (df/dtheta)^T w is added into theta_bar (P,) in place.  No matrix is formed
        for an effect that has a `vjp`."""
        by_q, by_v = np.zeros(self.n), np.zeros(self.n)
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            q_bar, v_bar, bar = products(effect, t, (q, v), w)
            by_q += q_bar
            by_v += v_bar
            _add(theta_bar, bar, parameters, getattr(effect, "columns", None))
        return by_q, by_v

    def curvature(
        self, t: float, place: tuple[Array, Array], w: Array, change: tuple[Array, Array, Array], theta_bar: Array
    ) -> tuple[Array, Array]:
        """The derivative of `vjp` along change = (dq (n,), dv (n,), dtheta (P,)) at fixed w: (dK^T w, dD^T w);
        d(df/dtheta)^T w is added into theta_bar (P,) in place.  `curvature_differenced` names its differences."""
        by_q, by_v = np.zeros(self.n), np.zeros(self.n)
        dq, dv, dtheta = change
        for effect, parameters in zip(self.effects, self.layout, strict=True):
            columns = getattr(effect, "columns", None)
            q_bar, v_bar, bar = curvature_of(effect, t, place, w, (dq, dv, _take(dtheta, parameters, columns)))
            by_q += q_bar
            by_v += v_bar
            _add(theta_bar, bar, parameters, columns)
        return by_q, by_v

    @property
    def curvature_differenced(self) -> tuple[str, ...]:
        """The effects whose second derivatives come from finite differences (nine to ten digits)."""
        return tuple(effect.name for effect in self.effects if is_differenced(effect))

    # How a rule's outcome becomes a state: here by doing nothing (`steppers.charts` has the others)

    def leave(self, parts: Any) -> Array:
        """(q, v) -> y."""
        return np.concatenate(list(parts))

    def leave_tangent(self, parts: Any, dparts: Any, start: Any) -> Array:
        return np.concatenate(list(dparts))

    def leave_vjp(self, parts: Any, mu: Array) -> tuple[Array, float]:
        return mu.reshape(2, self.n, *mu.shape[1:]), 0.0

    def carry(self, place: Any, dplace: Any, start: Any) -> Any:
        return dplace

    def carry_vjp(self, place: Any, bars: Any) -> tuple[Any, float]:
        return bars, 0.0

    # The operations of a stage k = M^-1 f(t, q, v), pinned entries 0

    def flow(self, t: float, y: Array) -> Array:
        """dy/dt = (v, M^-1 f): the reduction to first order, (2n,)."""
        q, v = self.blocks(y)
        return np.concatenate([v, self.rate(t, q, v)])

    def slope_by_turn(self, y: Array, slope: Array) -> Array:
        """dJ/dy (ny,) as a slope by small changes of place and velocity, (2n,): the same where positions add."""
        return slope

    def slope_by_state(self, y: Array, slope: Array) -> Array:
        """The way back of `slope_by_turn`: (2n,) -> (ny,)."""
        return slope

    def turned(self, v: Array, p: Array) -> Array:
        """The part of dp/dt (n,) of the adjoint equation that comes from turning frames: 0 where positions add."""
        return np.zeros_like(p)

    def rate(self, t: float, q: Array, v: Array) -> Array:
        """Acceleration M^-1 f (n,) m/s^2, 0 at pinned points."""
        return self.stage_solve(self.free * self.force(t, q, v))

    def stage_residual(self, k: Array, t: float, q: Array, v: Array) -> Array:
        """M k - f(t, q, v), N; pinned rows read M k = 0."""
        return self.momentum(k) - self.free * self.force(t, q, v)

    def stage_matrix(self, t: float, place: tuple[Any, ...], weights: tuple[float, float]) -> Any:
        """M - b K - c D, for a stage at q = q_s + b k, v = v_s + c k; pinned rows and columns are those of M.

        Dense where a dense factorization is quicker, else CSR.
        """
        terms = [(1.0, self.mass_matrix)]
        for weight, capability in zip(weights, ("dq", "dv"), strict=True):
            for effect in self.having(capability) if weight else ():
                terms.append((-weight, self.jacobian(effect, capability, (t, *place))))
        return self._total(_key(weights), terms, self.masses)

    def _total(self, key: tuple[Any, ...], terms: Sequence[tuple[float, csr_array]], pinned: Array | float) -> Any:
        """The sum of weight * matrix in the pattern of `key`, which is found once and shared by all copies."""
        factors, matrices = zip(*terms, strict=True) if terms else ((), ())
        if key not in self.patterns or not self.patterns[key].fits(matrices):
            self.patterns[key] = SumPattern(matrices, self.free)
        total = self.patterns[key].total(factors, matrices, (1 - self.free) * pinned)
        return total if self.n > DENSE_SIZE else total.toarray()

    def stage_band(self, weights: tuple[float, float]) -> Band | None:
        """Where the last `stage_matrix` lies in a band, if it is sparse, symmetric, and the band is worth storing."""
        used = [effect for name, w in zip(("dq", "dv"), weights, strict=True) if w for effect in self.having(name)]
        return self._band(_key(weights), used)

    def _band(self, key: tuple[Any, ...], used: Sequence[Effect]) -> Band | None:
        pattern = self.patterns.get(key)
        if self.n <= DENSE_SIZE or pattern is None or not pattern.symmetric:
            return None
        return pattern.band if all(_symmetric(effect) for effect in used) else None

    def stiffness(self, t: float, q: Array) -> Stiffness:
        """-K = -df/dq at rest (v = 0), the matrix of an equilibrium.

        Effects whose K vanishes here (all damping does) are left out, so that they do not spoil its symmetry.
        """
        place = (t, q, np.zeros(self.n))
        jacobians = [(effect, self.jacobian(effect, "dq", place)) for effect in self.having("dq")]
        acting = [(effect, matrix) for effect, matrix in jacobians if np.any(matrix.data)]
        size = float(sum(np.abs(matrix.data).max() for _, matrix in acting))
        key = ("stiffness", *(effect.name for effect, _ in acting))
        matrix = self._total(key, [(-1.0, matrix) for _, matrix in acting], size or 1.0)
        return Stiffness(matrix, size, self._band(key, [effect for effect, _ in acting]))

    def stage_solve(self, w: Array) -> Array:
        """M^-1 w, w (n,) or (n,k)."""
        return (w.T / self.masses).T

    # Products with M and with its derivatives

    @property
    def mass_matrix(self) -> csr_array:
        """M, CSR (n,n)."""
        return diagonal(self.masses)

    def inverse_root(self) -> csr_array:
        """W, CSR (n,n), with W^T M W = 1."""
        return diagonal(1 / np.sqrt(self.masses))

    def momentum(self, v: Array) -> Array:
        """M v (n,)."""
        return self.masses * v

    def momentum_dtheta(self, v: Array) -> csr_array:
        """d(M v)/dtheta, CSR (n,P)."""
        from scipy.sparse import csr_array

        points = np.repeat(np.arange(len(self.mass)), self.dimension)
        return csr_array((v, (np.arange(self.n), points)), shape=(self.n, self.parameter_count))

    def momentum_tangent(self, v: Array, dtheta: Array) -> Array:
        """dM v from dtheta (P,), or from columns of them."""
        change: Array = (v * np.repeat(dtheta[: len(self.mass)], self.dimension, axis=0).T).T
        return change

    def momentum_vjp(self, v: Array, w: Array, theta_bar: Array) -> None:
        """Adds (d(M v)/dtheta)^T w into theta_bar."""
        theta_bar[: len(self.mass)] += (v * w).reshape(len(self.mass), -1).sum(axis=1)

    def stage_partials(self, t: float, q: Array, v: Array) -> tuple[csr_array, csr_array]:
        """d(M k)/dq and d(M k)/dv, CSR (n,n), pinned rows 0."""
        from scipy.sparse import csr_array

        free = diagonal(self.free)
        return csr_array(free @ self.dq(t, q, v)), csr_array(free @ self.dv(t, q, v))

    def stage_dtheta(self, t: float, place: tuple[Array, Array], k: Array) -> csr_array:
        """df/dtheta - k dM/dtheta, CSR (n,P), pinned rows 0."""
        from scipy.sparse import csr_array

        return csr_array(diagonal(self.free) @ self.dtheta(t, *place) - self.momentum_dtheta(k))

    def stage_tangent(
        self, t: float, place: tuple[Array, Array], k: Array, dplace: tuple[Array, Array], dtheta: Array
    ) -> Array:
        """The change of f - M k at fixed k, N, 0 at pinned points: `stage_partials` and `stage_dtheta` times changes
        (n,) and (P,), or times columns of them, effect by effect."""
        total = np.zeros((self.n, *dtheta.shape[1:]))
        for capability, change in zip(("dq", "dv"), dplace, strict=True):
            for effect in self.having(capability):
                total += self.jacobian(effect, capability, (t, *place)) @ change
        for effect, places in self._differentiable():
            total += effect.dtheta(t, *place) @ dtheta[places]
        return (self.free * total.T).T - self.momentum_tangent(k, dtheta)

    def stage_vjp(
        self, t: float, place: tuple[Array, Array], k: Array, w: Array, theta_bar: Array
    ) -> tuple[Array, Array]:
        """Transposed `stage_partials` times w; transposed `stage_dtheta` times w is added into theta_bar."""
        w = self.free * w
        self.momentum_vjp(k, -w, theta_bar)
        return self.vjp(t, *place, w, theta_bar)

    def stage_curvature(
        self, t: float, place: tuple[Array, Array], w: Array, change: Any, theta_bar: Array
    ) -> tuple[Array, tuple[Array, Array]]:
        """The derivative of `stage_vjp`, and of its M^T w, along change = (dk, (dq, dv), dtheta) at fixed w: (dM^T w,
        (d(M k)/dq^T w, d(M k)/dv^T w)); the change of the parameters' gradient is added into theta_bar."""
        dk, dplace, dtheta = change
        inertia = self.momentum_tangent(w, dtheta)
        w = self.free * w
        self.momentum_vjp(dk, -w, theta_bar)
        return inertia, self.curvature(t, place, w, (*dplace, dtheta), theta_bar)

    def stage_energy(self, t: float, weights: tuple[float, float]) -> Callable[[Array, Array], float] | None:
        """Phi(k, q) = k^T M k / 2 + U(q) / b, whose gradient by k is the stage residual; None if there is none."""
        b, _ = weights
        if not self.conservative or b <= 0 or self.having("dv"):
            return None
        return lambda k, q: 0.5 * float(k @ self.momentum(k)) + self.potential(t, q) / b


def _key(weights: tuple[float, float]) -> tuple[bool, ...]:
    """Stages whose matrices have the same terms share a pattern."""
    return tuple(weight != 0 for weight in weights)


S = TypeVar("S", bound="System")


def fresh(system: S, **values: Any) -> S:
    """A copy without the cached properties of the original."""
    twin = replace(system, **values)
    for cached in ("theta", *(system.OF_MASS if "mass" in values else ())):
        twin.__dict__.pop(cached, None)
    return twin


def _add(theta_bar: Array, bar: Array | float, parameters: tuple[_Parameter, ...], columns: slice | None) -> None:
    """Add an effect's flat parameter gradient into theta_bar, touching only its entries."""
    if not parameters or not isinstance(bar, np.ndarray):
        return
    if columns is not None and columns.start is not None:  # a window, for an effect with a single parameter
        start = parameters[0].place.start
        theta_bar[start + columns.start : start + columns.stop] += bar
        return
    for p in parameters:
        theta_bar[p.place] += bar[p.own]


def _take(dtheta: Array, parameters: tuple[_Parameter, ...], columns: slice | None) -> Array:
    """An effect's own entries of theta (P,), in its own order; those of its window, where it has one."""
    if columns is not None and columns.start is not None:
        start = parameters[0].place.start
        return dtheta[start + columns.start : start + columns.stop]
    return np.concatenate([np.empty(0), *(dtheta[p.place] for p in parameters)])


def _symmetric(effect: Any) -> bool:
    """Whether dq and dv are declared symmetric, by the class that states them: a subclass may state others."""
    return bool(getattr(effect, "symmetric", False)) and current(effect, "symmetric", ("force", "dq", "dv"))


def _bound(effect: Any, mass: Array, dimension: int) -> Effect:
    if hasattr(effect, "bind_bodies") and not hasattr(effect, "bind"):
        raise ValueError(f"effects must be those of points; {effect.name} acts on rigid bodies: give it to RigidBodies")
    bound: Effect = effect.bind(mass, dimension) if hasattr(effect, "bind") else effect
    return bound


def as_effects(effects: Any) -> tuple[Effect, ...]:
    """One effect or several, checked: each has a force and a name of its own.  Raises ValueError."""
    effects = tuple(effects) if isinstance(effects, Iterable) else (effects,)
    for effect in effects:
        if not isinstance(effect, Effect) or isinstance(effect, type):
            raise ValueError(f"effects must have a name and a force(t, q, v); got {effect!r:.60}")
    names = [effect.name for effect in effects]
    for name in names:
        if not isinstance(name, str) or not name:
            raise ValueError(f"an effect's name must be a word; got {name!r:.60}")
        if names.count(name) > 1:
            raise ValueError(f'effects must have different names; got two called {name!r} (use name="...")')
        if name == "mass" or "." in name:
            raise ValueError(f'an effect may not be called {name!r}: "mass" and dots are taken')
    return effects


def as_fixed(fixed: Sequence[int] | NDArray[np.int64], count: int) -> tuple[int, ...]:
    """Sorted indices of pinned points among `count`.  Raises ValueError for one that is none."""
    try:
        indices = np.atleast_1d(fixed) if np.size(fixed) else np.empty(0, dtype=int)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"fixed must be whole numbers, indices of points; got {fixed!r:.60}") from error
    if indices.ndim != 1 or not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(f"fixed must be whole numbers, indices of points; got {fixed!r:.60}")
    found = sorted(set(indices.tolist()))  # np.unique would import numpy.ma, a tenth of dsim's start
    if found and (found[0] < 0 or found[-1] >= count):
        bad = found[0] if found[0] < 0 else found[-1]
        raise ValueError(f"fixed must be indices from 0 to {count - 1}; got {bad}")
    return tuple(found)


def layout_of(owned: dict[str, slice], effects: tuple[Effect, ...]) -> tuple[tuple[_Parameter, ...], ...]:
    """Where every parameter of every effect lies in theta, after the parameters of the system itself."""
    layout, start = [], max(place.stop for place in owned.values())
    for effect in effects:
        entries, own = [], 0
        for label in getattr(effect, "parameters", ()):
            shape = np.shape(getattr(effect, label))
            size = int(np.prod(shape))
            place = owned.get(label, slice(start, start + size))
            if label == "mass" and (part := getattr(effect, "masses", None)) is not None:  # of a part of the system
                place = slice(*part.indices(place.stop))
            start += 0 if label in owned else size
            entries.append(_Parameter(label, shape, slice(own, own + size), place))
            own += size
        layout.append(tuple(entries))
    return tuple(layout)


@dataclass(frozen=True, eq=False)
class Flow:
    """A first-order flow  dy/dt = phi(t, y).  Lecture: the leaf in a river.

    phi: callable (t, y (ny,)) -> (ny,).  jacobian: (t, y) -> (ny,ny); without one it is differenced
    (nine to ten digits), and `differenced` says so.  size: ny.
    """

    phi: Callable[[float, Array], Any]
    size: int
    jacobian: Callable[[float, Array], Any] | None = None

    components = 1
    curved = False
    parameter_count = 0
    theta = np.zeros(0)

    def __post_init__(self) -> None:
        if not callable(self.phi):
            raise ValueError(f"phi must be a callable (t, y) -> (ny,); got {self.phi!r:.60}")
        if self.jacobian is not None and not callable(self.jacobian):
            raise ValueError(f"jacobian must be a callable (t, y) -> (ny,ny); got {self.jacobian!r:.60}")
        object.__setattr__(self, "size", as_count("size", self.size, least=1))

    @property
    def n(self) -> int:
        return self.size

    width = n

    @property
    def differenced(self) -> bool:
        """True when the derivative comes from finite differences."""
        return self.jacobian is None

    curvature_differenced = ("phi",)  # what has its second derivatives from finite differences

    def blocks(self, y: Array) -> tuple[Array]:
        return (y,)

    def split(self, theta: Array) -> dict[str, Array]:
        """A flow has no named parameters."""
        return {}

    def at(self, t: float, y: Array, h: float) -> Flow:
        return self

    def rate(self, t: float, y: Array) -> Array:
        value = np.asarray(self.phi(t, y), dtype=float)
        if value.shape != (self.size,):
            raise ValueError(f"phi must return shape ({self.size},); got {value.shape}")
        return value

    flow = rate

    def check_start(self, y0: Array) -> None:
        """Any numbers are a state."""

    def leave(self, parts: Any) -> Array:
        """The state is its only block."""
        return np.asarray(parts[0])

    def leave_tangent(self, parts: Any, dparts: Any, start: Any) -> Array:
        return np.asarray(dparts[0])

    def leave_vjp(self, parts: Any, mu: Array) -> tuple[Any, float]:
        return (mu,), 0.0

    def carry(self, place: Any, dplace: Any, start: Any) -> Any:
        return dplace

    def carry_vjp(self, place: Any, bars: Any) -> tuple[Any, float]:
        return bars, 0.0

    def matrix(self, t: float, y: Array) -> Array:
        """dphi/dy (ny,ny)."""
        if self.jacobian is None:
            return _differenced(lambda z: self.rate(t, z), y)
        value = np.asarray(self.jacobian(t, y), dtype=float)
        if value.shape != (self.size, self.size):
            raise ValueError(f"jacobian must return shape {(self.size, self.size)}; got {value.shape}")
        return value

    def stage_residual(self, k: Array, t: float, y: Array) -> Array:
        return k - self.rate(t, y)

    def stage_matrix(self, t: float, place: tuple[Array], weights: tuple[float]) -> Array:
        return np.eye(self.size) - weights[0] * self.matrix(t, place[0])

    def stage_solve(self, w: Array) -> Array:
        return w

    def stage_partials(self, t: float, y: Array) -> tuple[csr_array]:
        from scipy.sparse import csr_array

        return (csr_array(self.matrix(t, y)),)

    def stage_dtheta(self, t: float, place: tuple[Array], k: Array) -> csr_array:
        from scipy.sparse import csr_array

        return csr_array((self.size, 0))

    def stage_tangent(self, t: float, place: tuple[Array], k: Array, dplace: tuple[Array], dtheta: Array) -> Array:
        change: Array = self.matrix(t, place[0]) @ dplace[0]
        return change

    def stage_vjp(self, t: float, place: tuple[Array], k: Array, w: Array, theta_bar: Array) -> tuple[Array]:
        return (self.matrix(t, place[0]).T @ w,)

    def stage_curvature(
        self, t: float, place: tuple[Array], w: Array, change: Any, theta_bar: Array
    ) -> tuple[float, tuple[Array]]:
        """(0, (dJ^T w,)) along change = (dk, (dy,), dtheta): J = dphi/dy by differences of the jacobian, to about ten
        digits; of phi itself, where it has none, to nine."""
        y, dy = place[0][None], change[1][0][None]
        if self.jacobian is None:
            turned = change_of_slopes(lambda z: self.rate(t, z[0])[None], y, dy)
        else:
            turned = change_of_jacobian(lambda z: self.matrix(t, z[0])[None], y, dy)
        return 0.0, (turned[0].T @ w,)

    def stage_energy(self, t: float, weights: tuple[float]) -> None:
        return None

    def stage_band(self, weights: tuple[float]) -> None:
        return None


def _differenced(f: Callable[[Array], Array], y: Array) -> Array:
    step = np.cbrt(np.finfo(float).eps) * np.maximum(1.0, np.abs(y))
    columns = []
    for i, width in enumerate(step):
        ahead, behind = y.copy(), y.copy()
        ahead[i] += width
        behind[i] -= width
        columns.append((f(ahead) - f(behind)) / (ahead[i] - behind[i]))
    return np.stack(columns, axis=1)
