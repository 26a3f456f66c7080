"""Initial value problems with a known answer, for work-precision studies: true states, and the true gradient.

The objective of every problem lies at the final time: J(y0) = w . z(T) + |z(T)|^2 / 2 with z = y / scale, so its
gradient sees the state and the flow's derivative alike.  Closed forms give both where the system is linear; elsewhere
the gradient follows from the adjoint differential equation, solved by two unrelated integrators.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from dsim import scenes
from dsim.arrays.checks import Array, as_array, as_count, as_positive
from dsim.effects import Field, Springs
from dsim.scenes.pendulum import GRAVITY
from dsim.studies.reference import DOP853, LSODA, RADAU, Reference
from dsim.system import System

SAMPLES = 24  # grid times compared, at least 20
GOLDEN = (np.sqrt(5) - 1) / 2
ROUND_OFF = 1e-14  # how well a closed form of numbers of size 1 is known

Solution = Callable[[float], Array]


@dataclass(frozen=True, eq=False)
class Truth:
    """What a method is measured against: states t -> y (ny,), and dJ/dy0 (ny,)."""

    name: str
    states: Solution
    gradient: Array


@dataclass(frozen=True, eq=False)
class Problem:
    """A second-order system on [0, duration] whose motion and gradient are known.

    exact: t -> y, where a closed form is known; else two integrators stand in.  transposed_flow: mu -> Phi(T)^T mu,
    where that is known too, Phi(T) = dy(T)/dy0.  position, velocity: the scales of an error, m and m/s.
    invariants: name -> (t, y) -> number, constant on the true motion.  coarsest: steps of the coarsest run.
    """

    name: str
    system: System
    y0: Array
    duration: float
    exact: Solution | None = None
    transposed_flow: Callable[[Array], Array] | None = None
    position: float = 1.0
    velocity: float = 1.0
    invariants: Mapping[str, Callable[[float, Array], float]] = field(default_factory=dict)
    coarsest: int = 32
    references: tuple[Reference, Reference] = (DOP853, RADAU)  # unrelated integrators: referees, and competitors

    def __post_init__(self) -> None:
        object.__setattr__(self, "y0", as_array("y0", self.y0, (self.system.size,)))
        for name in ("duration", "position", "velocity"):
            object.__setattr__(self, name, float(as_positive(name, getattr(self, name), ())))
        as_count("coarsest", self.coarsest, least=SAMPLES)

    @cached_property
    def scale(self) -> Array:
        """(ny,): `position` for q, `velocity` for v."""
        return np.repeat([self.position, self.velocity], [self.system.width, self.system.n])

    @cached_property
    def weights(self) -> Array:
        """w of the objective, (ny,): generic numbers, none at pinned points."""
        w = np.random.default_rng(7).normal(size=self.system.size)
        return w * self._free / np.sqrt(self._free.sum())

    @property
    def _free(self) -> Array:
        free = self.system.free
        return np.concatenate([free if len(free) == self.system.width else np.ones(self.system.width), free])

    def slope(self, final: Array) -> Array:
        """dJ/dy(T) (ny,) from the final state."""
        return (self.weights + self._free * final / self.scale) / self.scale

    def objective(self, final: Array) -> float:
        """J from the final state."""
        z = self._free * final / self.scale
        return float(self.weights @ z + 0.5 * z @ z)

    @cached_property
    def truths(self) -> tuple[Truth, ...]:
        """The closed form alone, or both references, of which none may judge itself."""
        if self.exact is not None and self.transposed_flow is not None:
            gradient = self.transposed_flow(self.slope(self.exact(self.duration)))
            return (Truth("closed form", self.exact, gradient),)
        found = []
        for reference in self.references:
            states = self.exact or solution(self, reference)
            found.append(Truth(reference.method, states, adjoint_equation(self, reference, states(self.duration))))
        return tuple(found)

    def truth(self, method: str = "") -> Truth:
        """The truth for `method`: never the method itself."""
        return next(truth for truth in self.truths if truth.name != method)

    @cached_property
    def certificate(self) -> float:
        """How well the states are known, in scaled units."""
        if self.exact is not None:
            return ROUND_OFF
        times = self.duration * np.arange(1, 201) / 200
        a, b = (np.stack([truth.states(t) for t in times]) for truth in self.truths)
        return max(ROUND_OFF, float(np.abs(self._apart(a, b)).max()))

    @cached_property
    def gradient_certificate(self) -> float:
        """How well the gradient is known, relative to its largest entry."""
        if len(self.truths) == 1:
            return ROUND_OFF
        return max(ROUND_OFF, self.gradient_error(self.truths[0].gradient, self.truths[1].gradient))

    def state_error(self, t: Array, y: Array, method: str = "") -> float:
        """Largest scaled error over at least 20 of the times t (N+1,), those nearest to incommensurate ones.

        Multiples of the golden ratio modulo 1 are no fractions of any period: at whole periods symplectic Euler
        would seem to have order 2.  The truth is evaluated at the method's own times; nothing is interpolated.
        """
        states = self.exact or self.truth(method).states  # a closed form needs no gradient beside it
        chosen = sample(t, self.duration)
        truth = np.stack([states(float(t[n])) for n in chosen])
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.abs(self._apart(y[chosen], truth)).max())

    def _apart(self, y: Array, truth: Array) -> Array:
        """Scaled differences of states (k,ny); attitudes of bodies are compared by the nearer of q and -q."""
        if self.system.curved:
            truth, width = np.array(truth), self.system.width
            for ours, theirs in zip(y, truth, strict=True):
                turns = self.system.frame.turns(theirs[:width])  # type: ignore[attr-defined]
                given = self.system.frame.turns(ours[:width])  # type: ignore[attr-defined]
                turns *= np.where((turns * given).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        return np.asarray((y - truth) / self.scale)

    def gradient_error(self, gradient: Array, truth: Array) -> float:
        """Largest difference, in scaled units, relative to the largest entry of the truth."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.abs((gradient - truth) * self.scale).max() / np.abs(truth * self.scale).max())

    def drift(self, t: Array, y: Array) -> dict[str, float]:
        """Largest relative change of every invariant at the sampled times."""
        chosen = sample(t, self.duration)
        found = {}
        with np.errstate(over="ignore", invalid="ignore"):
            for name, value in self.invariants.items():
                first = value(float(t[0]), y[0])
                found[name] = max(abs(value(float(t[n]), y[n]) - first) for n in chosen) / max(abs(first), 1e-300)
        return found


def sample(t: Array, duration: float) -> Array:
    """Indices of the times nearest to T {n phi}, n = 1 .. 24 (phi the golden ratio, {} the fraction), and of T."""
    wanted = duration * np.append(GOLDEN * np.arange(1, SAMPLES + 1) % 1.0, 1.0)
    right = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    nearest = np.where(wanted - t[right - 1] < t[right] - wanted, right - 1, right)
    return np.unique(np.maximum(nearest, 1))  # the start is known to everybody


def solution(problem: Problem, reference: Reference) -> Solution:
    """The motion by a SciPy integrator, with its own continuous output; the certificate covers that too."""
    system = problem.system
    options: dict[str, Any] = {"dense_output": True}
    if reference.method == "Radau":
        options["jac"] = lambda t, y: _jacobian(system, t, y)
    found = _integrate(system.flow, reference, problem.y0, (0.0, problem.duration), **options).sol
    return lambda t: np.asarray(found(t))


def adjoint_equation(problem: Problem, reference: Reference, final: Array) -> Array:
    """dJ/dy0 (ny,) by the adjoint differential equation, backward from the final state (ny,).

    With dq/dt = v, M dv/dt = f and K, D the derivatives of f:  dp/dt = -K^T M^-1 r,  dr/dt = -p - D^T M^-1 r,
    (p, r)(T) = dJ/dy(T), together with the state itself, so that no stored path is interpolated.  Of bodies p is by
    small turns delta in the body frame, d(delta)/dt = d(omega) - omega x delta, which adds -omega x p to dp/dt.
    """
    gradient, _ = adjoint_run(problem, reference, final)
    return gradient


def adjoint_run(problem: Problem, reference: Reference, final: Array) -> tuple[Array, Any]:
    """`adjoint_equation`, and SciPy's result with its counts."""
    system, size, n = problem.system, problem.system.size, problem.system.n
    scratch, zero = np.zeros(system.parameter_count), np.zeros(system.n)

    def flow(t: float, both: Array) -> Array:
        y, p, r = both[:size], both[size : size + n], both[size + n :]
        place = system.blocks(y)
        by_q, by_v = system.stage_vjp(t, place, zero, system.stage_solve(r), scratch)
        return np.concatenate([system.flow(t, y), system.turned(place[1], p) - by_q, -system.free * (p + by_v)])

    def slopes(t: float, both: Array) -> Array:
        # Newton needs no more: the part d(dp/dt, dr/dt)/dy, a second derivative of the forces, is left out
        J, zero = _jacobian(system, t, both[:size]), np.zeros((size, size))
        return np.block([[J, zero], [zero, -J.T]])

    start = np.concatenate([final, system.slope_by_turn(final, problem.slope(final))])
    options = {"jac": slopes} if reference.method == "Radau" else {}
    found = _integrate(flow, reference, start, (problem.duration, 0.0), **options)
    return system.slope_by_state(problem.y0, found.y[size:, -1]), found


def _jacobian(system: System, t: float, y: Array) -> Array:
    """d(dy/dt)/dy (ny,ny) of a second-order system."""
    place, inverse = system.blocks(y), system.stage_solve(np.ones(system.n))[:, None]
    K, D = (inverse * part(t, *place).toarray() for part in (system.dq, system.dv))
    return np.block([[np.zeros_like(K), np.diag(system.free)], [K, D * system.free]])


def _integrate(flow: Any, reference: Reference, y0: Array, span: tuple[float, float], **options: Any) -> Any:
    from scipy.integrate import solve_ivp

    atol = reference.rtol * max(1.0, float(np.abs(y0).max()))
    found = solve_ivp(flow, span, y0, reference.method, rtol=reference.rtol, atol=atol, **options)
    if not found.success:
        raise ArithmeticError(f"{reference.name} gave up: {found.message}")
    return found


# The problems


@lru_cache(maxsize=1)
def projectile() -> Problem:
    """A ball with linear drag, y(T) affine in y0: x = x0 + s (1 - e) v0 + ..., v = e v0 + ..., e = e^(-T/s)."""
    scene, duration = scenes.projectile(), 1.7
    s = 0.2 / 0.1  # mass / drag, s
    e = np.exp(-duration / s)

    def transposed(mu: Array) -> Array:
        return np.concatenate([mu[:2], -s * np.expm1(-duration / s) * mu[:2] + e * mu[2:]])

    return Problem("projectile", scene.system, scene.y0, duration, scene.exact, transposed, 10.0, 10.0)  # type: ignore


@lru_cache(maxsize=1)
def pendulum() -> Problem:
    """A rigid pendulum released at 2 rad, in its angle: theta'' = -(g/l) sin theta, l = 1 m.

    theta = 2 asin(k cd), theta' = -2 w k k'^2 sn / (dn^2 cos(theta/2)), Jacobi's functions at (w t, k^2).
    """
    w, k = np.sqrt(GRAVITY), np.sin(1.0)

    def exact(t: float) -> Array:
        from scipy.special import ellipj

        sn, _, dn, _ = ellipj(w * t, k**2)
        theta = scenes.rigid_pendulum_angle(t)
        return np.array([theta, -2 * w * k * (1 - k**2) * sn / dn**2 / np.cos(theta / 2)])

    swing = Field(
        lambda x: -GRAVITY * np.sin(x),
        lambda x: -GRAVITY * np.cos(x)[:, :, None],
        lambda x: -GRAVITY * np.cos(x[:, 0]),
        name="swing",
    )
    system = System([1.0], [swing], dimension=1)
    invariants = {"energy": system.energy}
    return Problem("pendulum", system, exact(0.0), 3.1, exact, velocity=float(w), invariants=invariants)


@lru_cache(maxsize=1)
def kepler() -> Problem:
    """A planet on an ellipse of eccentricity 0.6 for 1.16 periods; the gradient by complex steps of `two_bodies`."""
    scene, duration, tiny = scenes.kepler(0.6), 7.3, 1e-30

    def transposed(mu: Array) -> Array:
        start = np.asarray(scene.y0)[:, None] + 1j * tiny * np.eye(4)
        return np.array([(mu @ two_bodies(y0, duration)).imag / tiny for y0 in start.T])

    known = {"exact": scene.exact, "transposed_flow": transposed, "invariants": scene.invariants}
    return Problem("kepler", scene.system, scene.y0, duration, **known, coarsest=64)  # type: ignore


def two_bodies(y0: Array, t: float) -> Array:
    """y(t) from any y0 = (x, v) on an ellipse around GM = 1, analytic in y0, so that y0 may be complex.

    Lagrange's f and g in the change of the eccentric anomaly, u (Battin, Introduction to the Mathematics and Methods
    of Astrodynamics, sec. 4.3):  n t = u - c sin u + s (1 - cos u),  c = 1 - r/a,  s = x.v/sqrt(a),  n = a^(-3/2).
    """
    x, v = y0[:2], y0[2:]
    r = np.sqrt(x @ x)
    a = 1 / (2 / r - v @ v)
    n, c, s = a**-1.5, 1 - r / a, x @ v / np.sqrt(a)
    u = n * t
    for _ in range(60):  # converges from n t for the moderate eccentricities used here
        u = u - (u - c * np.sin(u) + s * (1 - np.cos(u)) - n * t) / (1 - c * np.cos(u) + s * np.sin(u))
    far, gone = a * (1 - c * np.cos(u) + s * np.sin(u)), 1 - np.cos(u)
    f, g = 1 - a / r * gone, t - (u - np.sin(u)) / n
    return np.concatenate([f * x + g * v, -np.sqrt(a) / (r * far) * np.sin(u) * x + (1 - a / far * gone) * v])


@lru_cache(maxsize=1)
def chain() -> Problem:
    """Six points on a line between two walls, springs of no rest length: all six normal modes at once."""
    rng = np.random.default_rng(3)
    moved, thrown = 0.1 * rng.normal(size=6), 0.5 * rng.normal(size=6)
    return line("chain", np.full(6, 0.5), np.full(7, 50.0), (moved, thrown), 2.3, velocity=1.0, position=0.1)


@lru_cache(maxsize=1)
def two_rates() -> Problem:
    """Stiff: a slow oscillation with w about 1/s, and one of about 90/s that is hardly excited.

    A method either resolves the fast one, h w << 1, or must be content with its amplitude as error.
    """
    return line("two-rates", np.ones(2), np.array([2.0, 4e3, 0.0]), (np.array([1.0, 1.0 + 1e-4]), np.zeros(2)), 3.7)


@lru_cache(maxsize=1)
def cloth() -> Problem:
    """A cloth of 8 x 8 points pinned at two corners falls for a third of a second; no closed form.

    Radau's order of five makes a gradient at 1e-12 take minutes; LSODA, Adams and BDF, is no relative of DOP853 either.
    """
    scene = scenes.cloth(n=8)
    return Problem("cloth", scene.system, scene.y0, 0.31, coarsest=32, references=(DOP853, LSODA))  # type: ignore


def line(
    name: str, mass: Array, stiffness: Array, moved: tuple[Array, Array], duration: float, **scales: Any
) -> Problem:
    """Points between two walls at 0 and 1, coupled by springs without rest length, hence linear.

    mass (n,) kg, stiffness (n+1,) N/m.  moved: displacements (n,) m from equilibrium, and velocities (n,) m/s.
    u(t) = M^-1/2 Q [cos(w t) Q^T M^1/2 u0 + sin(w t)/w Q^T M^1/2 v0],  M^-1/2 K M^-1/2 = Q w^2 Q^T,
    K tridiagonal with k_i + k_{i+1} on the diagonal and -k_{i+1} beside it.
    """
    n = len(mass)
    K = np.diag(stiffness[:-1] + stiffness[1:]) - np.diag(stiffness[1:-1], 1) - np.diag(stiffness[1:-1], -1)
    root = np.sqrt(mass)
    square, Q = np.linalg.eigh(K / np.outer(root, root))
    w, to, back = np.sqrt(square), Q.T * root, Q / root[:, None]
    rest = np.linalg.solve(K, stiffness[-1] * np.eye(n)[-1])  # the walls stand at 0 and 1

    def propagator(t: float) -> Array:
        c, s = np.cos(w * t)[:, None], np.sin(w * t)[:, None]
        return np.block(
            [[back @ (c * to), back @ (s / w[:, None] * to)], [back @ (-s * w[:, None] * to), back @ (c * to)]]
        )

    start = np.concatenate(moved)
    free = np.r_[1 : n + 1, n + 3 : 2 * n + 3]  # within [q, v] of n + 2 points

    def exact(t: float) -> Array:
        y = np.zeros(2 * n + 4)
        y[free] = propagator(t) @ start
        y[: n + 2] += [0.0, *rest, 1.0]
        return y

    walls = np.zeros((2 * n, 2))  # du(T)/d(wall): the equilibrium follows the wall
    static = np.linalg.solve(K, np.outer(np.eye(n)[0], [stiffness[0], 0]) + np.outer(np.eye(n)[-1], [0, stiffness[-1]]))
    walls[:n] = static
    walls -= propagator(duration)[:, :n] @ static

    def transposed(mu: Array) -> Array:
        out = np.zeros(2 * n + 4)
        out[free] = propagator(duration).T @ mu[free]
        out[[0, n + 1]] = mu[[0, n + 1]] + walls.T @ mu[free]
        return out

    pairs = np.stack([np.arange(n + 1), np.arange(1, n + 2)], axis=1)
    masses = np.concatenate([mass[:1], mass, mass[-1:]])
    system = System(masses, [Springs(pairs, 0.0, stiffness)], dimension=1, fixed=[0, n + 1])
    invariants = {"energy": system.energy}
    return Problem(name, system, exact(0.0), duration, exact, transposed, invariants=invariants, **scales)
