"""Gradient bugs that real simulators shipped, planted one by one into a copy that is right everywhere else.

Each is a `Simulator` whose states are right and whose gradient is not.  A checker that lets one pass is no checker:
`judge_program` must call every one of them wrong, and name the block of parameters and the first bad step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Drag, Gravity, SpringDamping, Springs
from dsim.gradients.adjoint import Gradient
from dsim.gradients.objectives import Variables
from dsim.kernels.spring import directions, edge_hessian
from dsim.steppers import BackwardEuler, SymplecticEuler
from dsim.steppers.stepper import Step, Stepper
from dsim.studies.verdicts.simulator import Method, Simulator, of_method
from dsim.system import System

H, STEPS = 0.02, 4
BLOCKS = ("positions", "velocities", "mass", "gravity.acceleration", "springs.stiffness")  # each in its own way
IMPLICIT = ("positions", "springs.stiffness")
PAIRS = ((0, 1), (1, 2), (2, 3), (0, 2))


@dataclass(frozen=True)
class PlantedBug:
    """family: what shipped, in a few words.  told: what this copy does.  make: () -> the program.

    wrong: block -> first bad step, for every block in which the bug shows; the others are right.
    """

    name: str
    family: str
    told: str
    make: Callable[[], Simulator]
    wrong: Mapping[str, int]


def specimen(
    springs: type[Springs] = Springs, damping: type[SpringDamping] = SpringDamping, drag: type[Drag] = Drag
) -> tuple[System, Array]:
    """Four points in the plane, one pinned, one spring pressed together."""
    x = np.array([[0.0, 0.0], [0.8, 0.1], [0.9, -0.7], [0.2, -0.9]])
    effects = (
        Gravity([0.3, -9.81]),
        drag([0.2, 0.4, 0.3, 0.5], wind=[1.0, -0.5]),
        springs(PAIRS, [0.7, 0.9, 0.5, 1.3], [40.0, 30.0, 50.0, 35.0]),
        damping(PAIRS, [0.3, 0.5, 0.2, 0.4]),
    )
    system = System([1.0, 0.8, 1.3, 0.6], effects, dimension=2, fixed=[0])
    v = np.array([[0.0, 0.0], [0.5, -0.3], [-0.4, 0.6], [0.7, 0.2]])
    return system, np.concatenate([x.ravel(), v.ravel()])


def right(stepper: Stepper | None = None) -> Simulator:
    """The specimen without a bug."""
    return _planted(specimen(), stepper or SymplecticEuler())


def _planted(case: tuple[System, Array], stepper: Stepper, method: type[Method] = Method) -> Simulator:
    system, y0 = case
    slow = isinstance(stepper, BackwardEuler)  # Newton takes its time
    variables = Variables(system, y0, IMPLICIT if slow else BLOCKS)
    return of_method(method(stepper, variables), (H, 2 if slow else STEPS), "planted")


# Derivatives of forces


class _ByMatrices:
    """Products from the matrices, so that a bug sits in one place."""

    def vjp(self: Any, t: float, q: Array, v: Array, w: Array) -> tuple[Any, Any, Any]:
        by_v = self.dv(t, q, v).T @ w if hasattr(self, "dv") else 0.0
        return self.dq(t, q, v).T @ w, by_v, self.dtheta(t, q, v).T @ w


class _FrozenDirection(_ByMatrices, Springs):
    """The hessian without the turning of the direction: k n n^T alone."""

    def dq(self, t: float, q: Array, v: Array) -> Any:
        scatter, edge, _ = self._edges(q)
        n = directions(edge)[1]
        return scatter.edge_matrix(-self.stiffness[:, None, None] * n[:, :, None] * n[:, None, :])


class _ProjectedHessian(_ByMatrices, Springs):
    """Negative eigenvalues of each spring's hessian set to 0, as Newton likes it; the adjoint must not."""

    def dq(self, t: float, q: Array, v: Array) -> Any:
        scatter, edge, theta = self._edges(q)
        values, vectors = np.linalg.eigh(edge_hessian(edge, theta))
        clipped = np.einsum("eik,ek,ejk->eij", vectors, np.maximum(values, 0.0), vectors)
        return scatter.edge_matrix(-clipped)


class _CountedTwice(_ByMatrices, Springs):
    """The first spring's block scattered twice: its degrees of freedom count double."""

    def dq(self, t: float, q: Array, v: Array) -> Any:
        scatter, edge, theta = self._edges(q)
        block = edge_hessian(edge, theta)
        block[0] *= 2
        return scatter.edge_matrix(-block)


class _NormalizedAtZero(_ByMatrices, Springs):
    """d|e|/de = e/|e|, without a thought for |e| = 0."""

    def dtheta(self, t: float, q: Array, v: Array) -> Any:
        scatter, x, _ = self._elements(q)
        edge = x[:, 1] - x[:, 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            length = np.sqrt((edge**2).sum(axis=1))
            n = edge / length[:, None]
        block = np.stack([-self.stiffness[:, None] * n, (length - self.rest_length)[:, None] * n], axis=2)
        return -scatter.mixed(np.stack([-block, block], axis=1))


class _DroppedTerm(_ByMatrices, SpringDamping):
    """f = -k_d (u . n) n differentiated by u alone: n depends on the positions too."""

    def dq(self, t: float, q: Array, v: Array) -> Any:
        return 0.0 * super().dq(t, q, v)


class _ShadowedConstant(_ByMatrices, Drag):
    """A constant that is 0 by the time the derivative reads it."""

    def dv(self, t: float, q: Array, v: Array) -> Any:
        return 0.0 * super().dv(t, q, v)


def _coincident() -> tuple[System, Array]:
    """Two more pinned points in one place, tied by a spring: its force is 0 whatever its stiffness is."""
    system, y0 = specimen()
    gravity, drag, springs, damping = system.effects
    pairs = [*PAIRS, (4, 5)]
    effects = (
        gravity,
        Drag(np.append(drag.coefficient, [0.1, 0.1]), wind=drag.wind),
        _NormalizedAtZero(pairs, np.append(springs.rest_length, 0.4), np.append(springs.stiffness, 20.0)),
        SpringDamping(PAIRS, damping.coefficient),
    )
    q, v = np.split(y0, 2)
    y0 = np.concatenate([q, [1.5, 0.5, 1.5, 0.5], v, np.zeros(4)])
    return System(np.append(system.mass, [1.0, 1.0]), effects, dimension=2, fixed=[0, 4, 5]), y0


# The way back


class _FlippedSign(Method):
    """dy/dtheta = +A^-1 C dtheta: the minus of the implicit function theorem is lost."""

    def gradient(self, x: Array, steps: int, h: float, w: Array) -> Array:
        run = self.run(x, steps, h)
        gradient = _swept(run, run.y, w)
        return self.variables.gather(Gradient(gradient.y0, -gradient.theta, {}))


class _StaleVelocities(Method):
    """A checkpoint after step 2 that restores the positions, and keeps the velocities of the step before."""

    def gradient(self, x: Array, steps: int, h: float, w: Array) -> Array:
        run = self.run(x, steps, h)
        states, kept = run.y.copy(), 2
        if steps > kept:
            n = self.variables.system.n
            stale = np.concatenate([states[kept, :n], states[kept - 1, n:]])
            system, _ = self.variables.place(x)
            states[kept] = stale
            for step in range(kept, steps):
                states[step + 1] = self.stepper.step(system, step * h, states[step], h).y1
        return self.variables.gather(_swept(run, states, w))


class _OffByOne(Method):
    """Every step is linearized at the state after it."""

    def gradient(self, x: Array, steps: int, h: float, w: Array) -> Array:
        run = self.run(x, steps, h)
        states = np.concatenate([run.y[1:], run.y[-1:]])
        return self.variables.gather(_swept(run, states, w))


class _GuardedMask(Method):
    """Pinned points have inverse mass 0; a derivative that divides by it, guarded by 1e-11, stays finite."""

    def gradient(self, x: Array, steps: int, h: float, w: Array) -> Array:
        run = self.run(x, steps, h)
        gradient = _swept(run, run.y, w)
        system: Any = run.system
        n, pinned = system.n, slice(0, system.dimension)  # point 0
        force = system.force(0.0, run.y[-2][:n], run.y[-2][n:])
        gradient.theta[0] -= h * float(force[pinned] @ w[n:][pinned]) / system.mass[0] ** 2 / 1e-11
        return self.variables.gather(gradient)


def _swept(run: Any, states: Array, w: Array) -> Gradient:
    """The adjoint, with every step linearized at states of the caller's."""
    stepper, system = run.stepper, run.system
    mu, theta_bar = w.copy(), np.zeros(system.parameter_count)
    for n in range(len(run.t) - 2, -1, -1):
        step = Step(n * run.h, run.h, states[n], states[n + 1])
        mu = stepper.linearize(system, step).pullback(mu, theta_bar)
    return Gradient(mu, theta_bar, {})


def _everywhere(step: int, **but: int) -> dict[str, int]:
    """Every block wrong from `step` on, some earlier."""
    return dict.fromkeys(BLOCKS, step) | but


def bugs() -> tuple[PlantedBug, ...]:
    """All of them, in the order of the list of shipped bugs.

    Where a bug must show follows from the formulas.  In symplectic Euler dv_1/dq_0 sees K = df/dq at once; by every
    other number dq_0 is 0, so K acts in step 2.  In backward Euler the matrix of every step holds K.
    """
    explicit, implicit = SymplecticEuler(), BackwardEuler()
    by_positions = _everywhere(2, positions=1)
    return (
        PlantedBug(
            "frozen direction",
            "a frozen contact normal",
            "a spring's direction is held fixed in the derivative of its force",
            lambda: _planted(specimen(springs=_FrozenDirection), explicit),
            by_positions,
        ),
        PlantedBug(
            "dropped term",
            "a friction chain-rule term dropped",
            "damping is differentiated by velocities, not by the positions its direction depends on",
            lambda: _planted(specimen(damping=_DroppedTerm), explicit),
            by_positions,
        ),
        PlantedBug(
            "flipped sign",
            "the sign of the implicit derivative flipped",
            "backward Euler: dy/dtheta without the minus of the implicit function theorem",
            lambda: _planted(specimen(), implicit, _FlippedSign),
            {"springs.stiffness": 1},
        ),
        PlantedBug(
            "stale velocities",
            "a checkpoint restored with stale velocities",
            "the state after step 2 is restored with the velocities after step 1",
            lambda: _planted(specimen(), explicit, _StaleVelocities),
            _everywhere(3),
        ),
        PlantedBug(
            "counted twice",
            "a double-counted degree of freedom",
            "one spring's block of the hessian is scattered twice",
            lambda: _planted(specimen(springs=_CountedTwice), explicit),
            by_positions,
        ),
        PlantedBug(
            "shadowed constant",
            "a penalty constant shadowed to 0",
            "the drag coefficient is 0 where the derivative reads it",
            lambda: _planted(specimen(drag=_ShadowedConstant), explicit),
            _everywhere(2, velocities=1),
        ),
        PlantedBug(
            "projected hessian",
            "a projected hessian used in the adjoint",
            "backward Euler: the hessian of a pressed spring made definite, for Newton and for the adjoint",
            lambda: _planted(specimen(springs=_ProjectedHessian), implicit),
            dict.fromkeys(IMPLICIT, 1),
        ),
        PlantedBug(
            "normalize at zero",
            "sqrt or normalize at 0",
            "e/|e| of a spring without length, inside the derivative alone",
            lambda: _planted(_coincident(), explicit),
            {"springs.stiffness": 1},
        ),
        PlantedBug(
            "guarded division",
            "gradients that are finite and wrong by 1e11",
            "a pinned point's inverse mass of 0, guarded by 1e-11 and divided by",
            lambda: _planted(specimen(), explicit, _GuardedMask),
            {"mass": 1},
        ),
        PlantedBug(
            "off by one",
            "a stale state",
            "every step is linearized at the state after it; constant forces do not notice at once",
            lambda: _planted(specimen(), explicit, _OffByOne),
            _everywhere(1) | {"gravity.acceleration": 2},
        ),
    )
