"""Hard cases 8 and 9: what must stay constant over long times, and what makes it drift."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from dsim import scenes
from dsim.arrays.checks import Array
from dsim.effects import Springs
from dsim.simulation import Trajectory, record
from dsim.solve.newton import newton
from dsim.steppers import ForwardEuler, ImplicitMidpoint, SymplecticEuler, VelocityVerlet
from dsim.steppers.stepper import Stepper
from dsim.studies.check import Check
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal, near, thinned
from dsim.system import System

# 8

STEPS_A_PERIOD = 1000
SYMPLECTIC: Mapping[str, Stepper] = {"symplectic Euler": SymplecticEuler(), "velocity Verlet": VelocityVerlet()}
# dE of the document, to the digits it gives: half a unit of the last one is the tolerance
KEPLER_ENERGY = {"symplectic Euler": (0.0178, 5e-5), "velocity Verlet": (2.93e-4, 5e-7)}


class _Drift(NamedTuple):
    """Relative change of energy and angular momentum at every state, (N+1,) each."""

    energy: Array
    momentum: Array


def kepler_drift(trajectory: Trajectory) -> _Drift:
    """E = |v|^2/2 - 1/r and L = x v_y - y v_x, relative to their start."""
    x, y, u, v = trajectory.y.T
    energy, momentum = (u**2 + v**2) / 2 - 1 / np.hypot(x, y), x * v - y * u
    return _Drift(energy / energy[0] - 1, momentum / momentum[0] - 1)


def orbit(full: bool = False, survivors: Mapping[str, Stepper] = SYMPLECTIC) -> HardCaseResult:
    """Kepler's ellipse, e = 0.6, GM = a = 1, 1000 steps a period: 100 periods in full, else 20.

    Symplectic methods conserve a modified energy, so that E swings and does not grow; their kicks are along the
    radius, so that L is constant to round-off.  Forward Euler spirals out.
    """
    periods = 100 if full else 20
    naive = _run(ForwardEuler(), 10)
    lost = kepler_drift(naive)
    drifts = {name: kepler_drift(_run(stepper, periods)) for name, stepper in survivors.items()}
    checks: list[Check] = []
    for name, drift in drifts.items():
        checks += _orbit_checks(name, drift, periods)
    angle = np.linspace(0, 2 * np.pi, 300)
    ellipse = Curve("truth", np.cos(angle) - 0.6, 0.8 * np.sin(angle))
    path = thinned(naive.q)
    curves = [_swings(name, drift.energy) for name, drift in {"forward Euler": lost, **drifts}.items()]
    failure = f"dE {np.abs(lost.energy).max():.0%}, dL {np.abs(lost.momentum).max():.0%}"
    found = [f"{np.abs(drift.energy).max():.3g}" for drift in drifts.values()]
    return HardCaseResult(
        (
            near("forward Euler", "dE after 10 periods", float(-lost.energy[-1]), 0.64, 0.005),
            near("forward Euler", "dL after 10 periods", float(np.abs(lost.momentum).max()), 0.22, 0.005),
        ),
        tuple(checks),
        (
            Panel("Forward Euler, 10 periods", "x (a)", "y (a)",
                  (Curve("forward Euler", path[:, 0], path[:, 1]), ellipse), equal=True),
            Panel(f"Symplectic, {periods} periods", "period", "largest |dE/E| in a period", tuple(curves), scale="log"),
        ),
        (failure, "dE " + ", ".join(found), "no growth"),
    )  # fmt: skip


def _run(stepper: Stepper, periods: int) -> Trajectory:
    scene = scenes.kepler(h=2 * np.pi / STEPS_A_PERIOD)
    return record(stepper, scene.system, scene.y0, scene.h, periods * STEPS_A_PERIOD)


def _orbit_checks(name: str, drift: _Drift, periods: int) -> tuple[Check, ...]:
    decade = 10 * STEPS_A_PERIOD
    energy = np.abs(drift.energy)
    growth = float(energy[-decade:].max() / energy[: decade + 1].max())
    return (
        equal(name, "periods completed", (len(energy) - 1) / STEPS_A_PERIOD, periods),
        near(name, f"largest dE in {periods} periods", float(energy.max()), *KEPLER_ENERGY[name]),
        at_most(name, "largest dE of the last 10 periods / of the first 10", growth, 1.05),
        at_most(name, f"largest dL in {periods} periods", float(np.abs(drift.momentum).max()), 1e-12),
    )


def _swings(name: str, energy: Array) -> Curve:
    largest = np.abs(energy[1:]).reshape(-1, STEPS_A_PERIOD).max(axis=1)
    return Curve(name, np.arange(1, len(largest) + 1), largest)


# 9


def spring_net(stiffness: float = 50.0) -> tuple[System, Array]:
    """Five free points of unequal mass on a ring with two braces, stretched, drifting and turning; and its state y0."""
    pairs = [(i, (i + 1) % 5) for i in range(5)] + [(0, 2), (1, 3)]
    mass = [0.5, 1.0, 2.0, 0.8, 1.3]
    system = System(mass, [Springs(pairs, 1.1, stiffness)], dimension=2)
    angle = 2 * np.pi * np.arange(5) / 5
    x = np.stack([1.2 * np.cos(angle), 0.9 * np.sin(angle)], axis=1)
    v = 0.8 * np.stack([-x[:, 1], x[:, 0]], axis=1) + [0.3, -0.2]
    return system, np.concatenate([x.ravel(), v.ravel()])


class _Momenta(NamedTuple):
    """|P - P0| relative to sum m |v|, and |L - L0| relative to sum m |x cross v|, at every state (N+1,)."""

    linear: Array
    angular: Array


def momenta(system: System, y: Array) -> _Momenta:
    """P = sum m v, L = sum m (x cross v) along states y (N+1,2n); the scales are the largest sums of the run."""
    x, v = (block.reshape(len(y), -1, 2) for block in (y[:, : system.n], y[:, system.n :]))
    P = np.einsum("p,tpd->td", system.mass, v)
    turns = x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]
    L, speeds = turns @ system.mass, np.linalg.norm(v, axis=2) @ system.mass
    around = np.abs(turns) @ system.mass
    return _Momenta(np.linalg.norm(P - P[0], axis=1) / speeds.max(), np.abs(L - L[0]) / around.max())


class JacobiCg:
    """A x = b by conjugate gradients, preconditioned with the diagonal, stopped at |r| <= tol |b|.

    What is left over, r, is a force that no spring exerts: its sum is not 0, and P leaks.
    """

    def __init__(self, matrix: Array, tol: float) -> None:
        self.matrix, self.tol = matrix, tol

    def solve(self, b: Array) -> Array:
        x, r, scale = np.zeros_like(b), b.copy(), 1 / np.diag(self.matrix)
        z = scale * r
        p, rz = z, r @ z
        for _ in range(10 * len(b)):
            if np.linalg.norm(r) <= self.tol * np.linalg.norm(b):
                break
            Ap = self.matrix @ p
            alpha = rz / (p @ Ap)
            x, r = x + alpha * p, r - alpha * Ap
            z = scale * r
            rz, before = r @ z, rz
            p = z + rz / before * p
        return x


def midpoint_by_cg(system: System, y0: Array, h: float, steps: int, tol: float) -> Array:
    """The implicit midpoint rule whose Newton solves its linear systems by `JacobiCg`: states (N+1,2n).

    k = M^-1 f(q + h v/2 + h^2 k/4), then q += h v + h^2 k/2 and v += h k.  Newton stops at corrections of `tol`.
    """
    states = [np.asarray(y0, dtype=float)]
    for _ in range(steps):
        q, v = system.blocks(states[-1])
        places = (q + h / 2 * v, v)

        def place(k: Array, places: tuple[Array, Array] = places) -> tuple[Array, Array]:
            return places[0] + h**2 / 4 * k, places[1] + h / 2 * k

        result = newton(
            lambda k, place=place: system.stage_residual(k, 0.0, *place(k)),  # type: ignore[misc]
            lambda k, place=place: JacobiCg(system.stage_matrix(0.0, place(k), (h**2 / 4, h / 2)), tol),  # type: ignore[misc]
            np.zeros(system.n),
            tol=tol,
            globalize="none",
        )
        k = result.z
        states.append(np.concatenate([q + h * v + h**2 / 2 * k, v + h * k]))
    return np.stack(states)


def free_net(
    full: bool = False, survivor: Stepper = SYMPLECTIC["symplectic Euler"], inner: Any = None
) -> HardCaseResult:
    """Internal central forces on a free spring net: P and L are constant.  h = 0.02 s, 1e4 steps with symplectic
    Euler; the implicit midpoint rule takes 1e4 in full, else 200.  inner: tolerance of its CG, None for direct solves.

    A loose Newton tolerance alone leaks no P: the columns of K sum to 0, so every Newton correction with an exact
    linear solve keeps sum M k = 0, however early it stops.  P leaks when the *linear* systems are solved loosely (a
    residual of CG is a force from nowhere); and L, a quadratic invariant, leaks when Newton stops early.
    """
    system, y0 = spring_net()
    h, steps, implicit = 0.02, 10_000, 10_000 if full else 200
    quick = momenta(system, record(survivor, system, y0, h, steps).y)
    loose = momenta(system, record(ImplicitMidpoint(tol=0.5, globalize="none"), system, y0, h, implicit).y)
    leaky = momenta(system, midpoint_by_cg(system, y0, h, implicit, 0.01))
    tight_states = (
        record(ImplicitMidpoint(tol=1e-12), system, y0, h, implicit).y
        if inner is None
        else midpoint_by_cg(system, y0, h, implicit, inner)
    )
    tight = momenta(system, tight_states)
    P = {name: float(run.linear.max()) for name, run in _named(quick, loose, leaky, tight)}
    L = {name: float(run.angular.max()) for name, run in _named(quick, loose, leaky, tight)}
    return HardCaseResult(
        (
            at_least("midpoint, CG to 1e-2", "leak of P", P["leaky"], 1e-6),
            at_most("midpoint, Newton to 0.5, direct solver", "drift of P: none leaks", P["loose"], 1e-12),
            at_least("midpoint, Newton to 0.5, direct solver", "leak of L", L["loose"], 1e-6),
        ),
        (
            equal("symplectic Euler", "steps completed", len(quick.linear) - 1, steps),
            at_most("symplectic Euler", f"drift of P in {steps} steps / sum m |v|", P["quick"], 1e-12),
            at_most("symplectic Euler", f"drift of L in {steps} steps / sum m |x cross v|", L["quick"], 1e-11),
            equal("midpoint, Newton to 1e-12", "steps completed", len(tight.linear) - 1, implicit),
            at_most("midpoint, Newton to 1e-12", f"drift of P in {implicit} steps / sum m |v|", P["tight"], 1e-12),
        ),
        (
            _drifts("Loose solvers", {"P, CG to 1e-2": leaky.linear, "L, Newton to 0.5": loose.angular,
                                      "P, Newton to 0.5, direct": loose.linear}),
            _drifts("Tight, or explicit", {"L, symplectic Euler": quick.angular, "P, symplectic Euler": quick.linear,
                                           "P, midpoint to 1e-12": tight.linear}),
        ),
        (f"P leaks {P['leaky']:.0e}", f"P {P['quick']:.0e}, L {L['quick']:.0e}", "P 1e-12, L 1e-11"),
    )  # fmt: skip


def _named(*runs: _Momenta) -> zip[tuple[str, _Momenta]]:
    return zip(("quick", "loose", "leaky", "tight"), runs, strict=True)


def _drifts(title: str, runs: Mapping[str, Array]) -> Panel:
    curves = []
    for name, drift in runs.items():
        worst = np.maximum.accumulate(drift)[1:]  # the largest so far: what a threshold is compared with
        places = thinned(np.arange(len(worst)), 300)
        curves.append(Curve(name, places + 1, np.maximum(worst[places], 1e-17)))
    return Panel(title, "step", "largest drift so far, relative", tuple(curves), scale="log")
