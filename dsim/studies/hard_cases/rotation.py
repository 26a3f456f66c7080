"""Hard cases 10 to 13: a racket that flips, a fast wobble, a heavy top, and quaternions that are only added to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.effects.bodies import BodyLayout
from dsim.rigid import RigidBodies
from dsim.simulation import Trajectory, record
from dsim.solve.newton import Status
from dsim.steppers import RKMK4, ForwardEuler, ImplicitMidpoint, NormalisedEuler, SymplecticEuler
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal, near, thinned

MIDPOINT = ImplicitMidpoint(tol=1e-13)


def free_body(moments: Any, spin: Any) -> tuple[RigidBodies, Array]:
    """One body of 1 kg with these principal moments (kg m^2), at rest but for its spin (rad/s, body frame)."""
    system = RigidBodies([1.0], np.diag(moments))
    return system, system.state([0.0, 0.0, 0.0], None, 0.0, spin)


def spins(run: Trajectory) -> Array:
    """omega (N+1,3) of a single body."""
    return run.y[:, 10:13]


def invariants(moments: Any, w: Array) -> tuple[Array, Array]:
    """2 E and |L|^2 over a run."""
    I = np.asarray(moments)
    return (I * w**2).sum(axis=-1), (I**2 * w**2).sum(axis=-1)


def drifts(moments: Any, w: Array) -> tuple[float, float]:
    """The largest relative changes of E and of |L|^2."""
    return tuple(float(np.abs(values / values[0] - 1).max()) for values in invariants(moments, w))  # type: ignore


def intermediate_axis(moments: Any, w0: Any) -> tuple[float, float]:
    """(time of the first change of sign of omega_2, time between changes), by Jacobi's elliptic functions.

    For I1 < I2 < I3 and |L|^2 > 2 E I2:  omega_2 = a sn(p t + t0 | m), a^2 = (2 E I3 - L^2) / (I2 (I3 - I2)),
    p^2 = (I3 - I2)(L^2 - 2 E I1) / (I1 I2 I3), m = (I2 - I1)(2 E I3 - L^2) / ((I3 - I2)(L^2 - 2 E I1)).
    Landau and Lifshitz, Mechanics, sec. 37.
    """
    from scipy.special import ellipk, ellipkinc

    i1, i2, i3 = moments
    w = np.asarray(w0, dtype=float)
    e, L = (float(value) for value in invariants(moments, w))
    if L <= e * i2:
        raise ValueError(f"the motion must be about the largest moment, |L|^2 > 2 E I2; got {L:.6g} <= {e * i2:.6g}")
    a = np.sqrt((e * i3 - L) / (i2 * (i3 - i2)))
    p = np.sqrt((i3 - i2) * (L - e * i1) / (i1 * i2 * i3))
    m = (i2 - i1) * (e * i3 - L) / ((i3 - i2) * (L - e * i1))
    half = 2 * ellipk(m) / p
    phase = ellipkinc(np.arcsin(np.clip(w[1] / a, -1, 1)), m) / p  # since the last rise through 0
    rising = w[0] * w[2] > 0  # I2 w2' = (I3 - I1) w3 w1
    return float((half - phase if rising else phase) % half), float(half)


def crossings(t: Array, x: Array) -> Array:
    """Times at which x changes its sign, by cubic interpolation between four states."""
    places = np.flatnonzero(x[:-1] * x[1:] < 0)
    found = []
    for n in places[(places >= 1) & (places + 2 < len(x))]:
        window = slice(n - 1, n + 3)
        polynomial = np.polynomial.Polynomial.fit(t[window], x[window], 3)
        roots = polynomial.roots()
        real = roots[np.abs(roots.imag) < 1e-9].real
        found.append(real[np.argmin(np.abs(real - 0.5 * (t[n] + t[n + 1])))])
    return np.array(found)


# 10

RACKET, TOSSED = (1.0, 2.0, 3.0), (0.01, 1.0, 0.01)


def racket(full: bool = False, survivor: Any = MIDPOINT) -> HardCaseResult:
    """Spun about its middle axis a body flips, with a period by elliptic functions.  Forward Euler feeds it."""
    first, half = intermediate_axis(RACKET, TOSSED)
    system, y0 = free_body(RACKET, TOSSED)
    h, long = (0.01, 1000.0) if full else (0.04, 200.0)
    naive = record(ForwardEuler(), system, y0, h, round(long / h))
    gained = float(invariants(RACKET, spins(naive))[0][-1] / invariants(RACKET, spins(naive))[0][0] - 1)
    runs = {step: record(survivor, system, y0, step, round(32.0 / step)) for step in (2 * h, h)}
    errors = {step: _flips(run, first, half) for step, run in runs.items()}
    energy, momentum = drifts(RACKET, spins(runs[h]))
    allowed = 1e-5 * (h / 0.01) ** 2
    shown = runs[h]
    return HardCaseResult(
        (at_least("forward Euler", f"energy gained by {long:g} s", gained, 0.5 if full else 0.3),),
        (
            near("truth", "first flip (s)", first, 10.9169, 5e-5),
            near("truth", "time between flips (s)", half, 19.5528671, 5e-8),
            at_most("midpoint, Cayley", f"error of the flips, h = {h:g}, relative", errors[h], allowed),
            near("midpoint, Cayley", "order of the flips' error", np.log2(errors[2 * h] / errors[h]), 2.0, 0.2),
            at_most("midpoint, Cayley", "drift of the energy", energy, 1e-12),
            at_most("midpoint, Cayley", "drift of |L|^2", momentum, 1e-12),
        ),
        (
            Panel("Forward Euler", "time (s)", "omega_2 (rad/s)", (
                _spin("forward Euler", naive), _true_flips(first, half, long))),
            Panel("Implicit midpoint with the Cayley map", "time (s)", "omega_2 (rad/s)", (
                _spin("midpoint", shown), _true_flips(first, half, 32.0))),
        ),
        (f"E +{gained:.0%}", f"flips {errors[h]:.1e}", f"{allowed:.0e}"),
    )  # fmt: skip


def _spin(name: str, run: Trajectory) -> Curve:
    return Curve(name, thinned(run.t), thinned(spins(run)[:, 1]))


def _true_flips(first: float, half: float, end: float) -> Curve:
    t = np.arange(first, end, half)
    return Curve("flips, elliptic functions", t, np.zeros(len(t)), points=True)


def _flips(run: Trajectory, first: float, half: float) -> float:
    found = crossings(run.t, spins(run)[:, 1])
    expected = first + half * np.arange(len(found))
    return float(np.abs(found - expected).max() / half) if len(found) >= 2 else np.inf


# 11

WOBBLER, FAST = (1.0, 1.2, 2.0), (5.0, 1.0, 100.0)


def fast_wobble(full: bool = False, survivor: Any = MIDPOINT) -> HardCaseResult:
    """A body that spins a third of a turn a step: explicit Euler is gone within a second."""
    system, y0 = free_body(WOBBLER, FAST)
    h, steps = 1 / 60, 6000 if full else 300
    naive = record(ForwardEuler(), system, y0, h, 60)
    good = record(survivor, system, y0, h, steps)
    energy, momentum = drifts(WOBBLER, spins(good))
    wobble = np.hypot(*spins(good)[:, :2].T)
    kept = wobble[-150:].max() / wobble[:150].max()
    return HardCaseResult(
        (
            equal("forward Euler", "ends as not finite", float(naive.status is Status.NOT_FINITE), 1.0),
            near("forward Euler", "the step that is not finite", float(len(naive.t)), 20.0, 1.0),
        ),
        (
            equal("midpoint, Cayley", "steps completed", float(len(good.t) - 1), float(steps)),
            at_most("midpoint, Cayley", "drift of the energy", energy, 1e-12),
            at_most("midpoint, Cayley", "drift of |L|^2", momentum, 1e-12),
            at_least("midpoint, Cayley", "the wobble's last swing / its first", kept, 0.999),
        ),
        (
            Panel("Forward Euler", "time (s)", "wobble |omega_1, omega_2| (rad/s)",
                  (Curve("forward Euler", naive.t, np.hypot(*spins(naive)[:, :2].T)),), scale="log"),
            Panel("Implicit midpoint with the Cayley map", "time (s)", "wobble |omega_1, omega_2| (rad/s)",
                  (Curve("midpoint", good.t[:120], wobble[:120]),)),
        ),
        (f"not finite in step {len(naive.t)}", f"dE {energy:.0e}, dL {momentum:.0e}", "1e-12"),
    )  # fmt: skip


# 12


@dataclass(frozen=True)
class TopWeight:
    """The couple of a weight m g l = 1 N m on the axis and its support at the tip: 1 * e_z x R^T (0, 0, -1)."""

    name: str = "weight"
    layout: BodyLayout | None = None

    def bind_bodies(self, layout: BodyLayout) -> TopWeight:
        return TopWeight(self.name, layout)

    def force(self, t: float, q: Array, v: Array) -> Array:
        assert self.layout is not None
        down = rotation.rotate(rotation.conjugate(self.layout.turns(q)), np.array([0.0, 0.0, -1.0]))
        out = np.zeros(self.layout.n)
        self.layout.spins(out)[:, 0], self.layout.spins(out)[:, 1] = -down[:, 1], down[:, 0]
        return out


def heavy_tops(tilt: Any, spin: Any, precession: Any) -> tuple[RigidBodies, Array]:
    """Tops on their tips, all at once: I1 = 1, I3 = 0.5 kg m^2 about the tip, m g l = 1 N m.  All (B,).

    A tip is the centre of a body.  tilt: of the axis from the vertical, rad; spin: omega_3; precession: turns of the
    axis about the vertical, rad/s.
    """
    tilt, spin, precession = np.broadcast_arrays(*map(np.atleast_1d, (tilt, spin, precession)))
    zero = np.zeros(len(tilt))
    system = RigidBodies(np.ones(len(tilt)), np.diag([1.0, 1.0, 0.5]), [TopWeight()])
    attitude = rotation.exponential(np.stack([zero, tilt, zero], axis=1))
    w = np.stack([-precession * np.sin(tilt), zero, spin], axis=1)
    return system, system.state([0.0, 0.0, 0.0], attitude, 0.0, w)


TURNS_BACK = 0.5338654039  # rad: the largest tilt of the top that is let go, from its energy and momenta


def slow_precession(tilt: float, spin: float) -> float:
    """The slow root of I1 W^2 cos(tilt) - I3 w3 W + m g l = 0, rad/s."""
    a, b = np.cos(tilt), 0.5 * spin
    return float(2.0 / (b + np.sqrt(b**2 - 4 * a)))


def axes_of(system: RigidBodies, run: Trajectory) -> Array:
    """The axes in the world, (N+1,B,3)."""
    turns = run.q.reshape(len(run.t), system.frame.bodies, 7)[:, :, 3:]
    return rotation.rotate(turns, np.array([0.0, 0.0, 1.0]))


def spinning_top(full: bool = False, survivor: Any = None) -> HardCaseResult:
    """Steady precession, nutation of a top let go, and the spin above which an upright one sleeps."""
    tilt, spin, T, h = np.radians(30.0), 20.0, 20.0, 0.005
    W = slow_precession(tilt, spin)
    system, y0 = heavy_tops([tilt, tilt, 1e-3, 1e-3], [spin, spin, 3.9, 4.1], [W, 0.0, 0.0, 0.0])
    run = record(survivor or RKMK4(), system, y0, h, round(T / h))
    axes = axes_of(system, run)
    tilts = np.arctan2(np.hypot(axes[..., 0], axes[..., 1]), axes[..., 2])
    angle = np.unwrap(np.arctan2(axes[:, 0, 1], axes[:, 0, 0]))
    rate = float((angle[-1] - angle[0]) / T)
    naive = 1.0 / (0.5 * spin)  # m g l / (I3 w3), as textbooks say
    shown = run.t <= 2.0
    return HardCaseResult(
        (near("m g l / (I3 w3)", "relative error of the precession", naive / W - 1, -0.00874, 1e-4),),
        (
            near("truth", "slow precession (rad/s)", W, 0.1008813582, 5e-11),
            at_most("RKMK4", "drift of the tilt in 20 s (rad)", float(np.abs(tilts[:, 0] - tilt).max()), 1e-6),
            at_most("RKMK4", "error of the precession, relative", abs(rate / W - 1), 1e-5),
            near("RKMK4", "largest tilt after release (rad)", float(tilts[:, 1].max()), TURNS_BACK, 2e-6),
            at_least("RKMK4", "tilt of an upright top at w3 = 3.9: it falls (rad)", float(tilts[:, 2].max()), 0.02),
            at_most("RKMK4", "tilt of an upright top at w3 = 4.1: it sleeps (rad)", float(tilts[:, 3].max()), 0.01),
        ),
        (
            Panel("Let go without precession: it nods", "time (s)", "tilt (rad)", (
                Curve("RKMK4", run.t[shown], tilts[shown, 1]), Curve("steady", run.t[shown], tilts[shown, 0]),
                Curve("turns back, by its invariants", run.t[shown], np.full(shown.sum(), TURNS_BACK)))),
            Panel("Steady precession", "time (s)", "angle of the axis - the exact one (rad)", (
                Curve("textbook: m g l / (I3 w3)", thinned(run.t), thinned((naive - W) * run.t)),
                Curve("RKMK4", thinned(run.t), thinned(angle - angle[0] - W * run.t)))),
        ),
        (f"rate off {abs(naive / W - 1):.2%}", f"rate off {abs(rate / W - 1):.0e}", "1e-5"),
    )  # fmt: skip


# 13


def added_quaternions(full: bool = False, survivor: Any = None) -> HardCaseResult:
    """10 rad/s for 1000 steps of 0.01 s: q + h qdot grows; normalised it turns too slowly; the exponential is exact."""
    w, h, steps = np.array([0.0, 0.0, 10.0]), 0.01, 1000
    q, norms = np.array([1.0, 0.0, 0.0, 0.0]), [1.0]
    for _ in range(steps):
        q = q + h / 2 * rotation.body_rates(q) @ w
        norms.append(float(np.linalg.norm(q)))
    system, y0 = free_body((1.0, 1.0, 1.0), w)
    runs = {"normalised": record(NormalisedEuler(), system, y0, h, steps),
            "exponential": record(survivor or SymplecticEuler(), system, y0, h, steps)}  # fmt: skip
    lost = {name: 10.0 * run.t - _turned(run) for name, run in runs.items()}
    t, most = h * np.arange(steps + 1), float(np.abs(lost["exponential"]).max())
    off = float(np.abs(np.linalg.norm(runs["exponential"].y[:, 3:7], axis=1) - 1).max())
    return HardCaseResult(
        (
            near("q + h qdot", "norm after 1000 steps", norms[-1], 3.4849, 5e-5),
            near("q + h qdot, normalised", "angle lost (rad)", float(lost["normalised"][-1]), 0.0832, 5e-5),
        ),
        (
            at_most("exponential", "angle lost (rad)", most, 1e-11),
            at_most("exponential", "|norm - 1|", off, 1e-14),
        ),
        (
            Panel("Added to", "time (s)", "norm of the quaternion", (Curve("q + h qdot", t, np.array(norms)),)),
            Panel("Normalised, and the exponential", "time (s)", "angle lost (rad)",
                  tuple(Curve(name, runs[name].t, values) for name, values in lost.items())),
        ),
        (f"norm {norms[-1]:.3f}, {lost['normalised'][-1]:.4f} rad", f"{most:.0e} rad", "1e-11"),
    )  # fmt: skip


def _turned(run: Trajectory) -> Array:
    """The angle about z since the start, rad, without jumps."""
    half = np.unwrap(np.arctan2(run.y[:, 6], run.y[:, 3]))
    return np.asarray(2 * half)
