"""Problems of bodies with a known motion: a free top of three moments, by Jacobi's functions, and a heavy top.

Angular velocities are elliptic functions; the attitude follows from the constant angular momentum and one angle, whose
rate is smooth and is summed by Gauss's rule.  Landau and Lifshitz, Mechanics, sec. 35 and 37; Leimanis (1965).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from dsim.arrays import rotation
from dsim.arrays.checks import Array
from dsim.effects import Field
from dsim.effects.at_points import Attached
from dsim.rigid import RigidBodies
from dsim.studies.problems import Problem
from dsim.studies.reference import DOP853, LSODA

NODES = 200  # of Gauss's rule, for an angle over a problem's whole duration
Z, X, Y = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def turn(axis: Array, angle: float) -> Array:
    """The quaternion (4,) of a turn about an axis of the frame."""
    return rotation.exponential(angle * axis[None])[0]


def chained(*turns: Array) -> Array:
    """q1 (x) q2 (x) ..."""
    total = turns[0]
    for each in turns[1:]:
        total = rotation.product(total[None], each[None])[0]
    return total


def summed(rate: Callable[[Array], Array], t: float) -> float:
    """The integral of a smooth rate from 0 to t, by Gauss's rule."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    return float(0.5 * t * (w @ rate(0.5 * t * (x + 1))))


@dataclass(frozen=True)
class FreeTop:
    """A free body of moments I1 < I2 < I3, turning about the largest: |L|^2 > 2 E I2.  spin (3,) rad/s at t = 0.

    w1 = a1 cn, w2 = -+ a2 sn, w3 = a3 dn of (p (t - t0) | m);  the attitude is A Rz(phi) Rx(theta) Rz(psi) with
    L = |L| (sin theta sin psi, sin theta cos psi, cos theta) in the body, and
    phi' = |L| (I1 w1^2 + I2 w2^2) / (I1^2 w1^2 + I2^2 w2^2).
    """

    moments: tuple[float, float, float]
    spin: tuple[float, float, float]

    @cached_property
    def _constants(self) -> tuple[Array, float, float, float]:
        """Amplitudes (3,) with signs, p, m, and the phase at t = 0."""
        from scipy.special import ellipkinc

        i1, i2, i3 = self.moments
        w = np.array(self.spin)
        I = np.array(self.moments)
        e, L = float(I @ w**2), float(I**2 @ w**2)
        if not i1 < i2 < i3 or L <= e * i2:
            raise ValueError(f"moments must rise and |L|^2 > 2 E I2; got {self.moments}, {L:.6g} <= {e * i2:.6g}")
        if not w[:2].any():
            raise ValueError(f"spin must be off the axis of the largest moment, or nothing tumbles; got {self.spin}")
        a1 = np.sqrt((e * i3 - L) / (i1 * (i3 - i1)))
        a2 = np.sqrt((e * i3 - L) / (i2 * (i3 - i2)))
        a3 = np.sqrt((L - e * i1) / (i3 * (i3 - i1))) * np.sign(w[2])
        p = np.sqrt((i3 - i2) * (L - e * i1) / (i1 * i2 * i3))
        m = (i2 - i1) * (e * i3 - L) / ((i3 - i2) * (L - e * i1))
        # with w1 = a1 cn and w3 = +-a3 dn, I2 w2' = (I3 - I1) w3 w1 makes w2 = +-a2 sn, of the sign of w3
        a2 *= np.sign(w[2])
        phase = np.arctan2(w[1] / a2, w[0] / a1)
        return np.array([a1, a2, a3]), float(p), float(m), float(ellipkinc(phase, m))

    def spins(self, t: Any) -> Array:
        """omega (...,3) at times t."""
        from scipy.special import ellipj

        amplitudes, p, m, phase = self._constants
        sn, cn, dn, _ = ellipj(p * np.asarray(t) + phase, m)
        return np.stack([cn, sn, dn], axis=-1) * amplitudes

    def _in_body(self, t: float) -> Array:
        """Rx(theta) Rz(psi), which brings L of the body to the axis z; psi without jumps, so that q has none."""
        from scipy.special import ellipj

        L = np.array(self.moments) * self.spins(t)
        theta, psi = np.arctan2(np.hypot(L[0], L[1]), L[2]), np.arctan2(L[0], L[1])
        amplitudes, p, m, phase = self._constants
        near = np.pi / 2 - np.sign(amplitudes[1]) * ellipj(p * t + phase, m)[3]
        psi += 2 * np.pi * np.round((near - psi) / (2 * np.pi))
        return chained(turn(X, float(theta)), turn(Z, float(psi)))

    def attitude(self, t: float) -> Array:
        """The unit quaternion (4,) at t, (1, 0, 0, 0) at 0."""
        I = np.array(self.moments)
        size = float(np.linalg.norm(I * self.spin))

        def rate(t: Array) -> Array:
            w = self.spins(t)[..., :2]
            return np.asarray(size * (w**2 @ I[:2]) / (w**2 @ I[:2] ** 2))

        start = rotation.conjugate(self._in_body(0.0)[None])[0]
        return chained(start, turn(Z, summed(rate, t)), self._in_body(t))

    def state(self, t: float) -> Array:
        """y (13,) of a body whose centre rests."""
        return np.concatenate([np.zeros(3), self.attitude(t), np.zeros(3), self.spins(t)])


@dataclass(frozen=True)
class HeavyTop:
    """A symmetric top on its tip: I1 = 1, I3 = 0.5 kg m^2 about the tip, m g l = 1 N m; let go at `tilt` with the spin
    w3 and the precession W about the vertical, and no nod: theta' = 0.

    u = cos theta = u1 + (u2 - u1) sn^2(p t + t0 | m), with the roots u1 < u2 < 1 < u3 of
    f(u) = (1 - u^2) 2 (E' - u) - (Lz - L3 u)^2;  p^2 = (u3 - u1)/2, m = (u2 - u1)/(u3 - u1);
    phi' = (Lz - L3 u)/(1 - u^2), psi' = w3 - phi' u, and R = Rz(phi) Ry(theta) Rz(psi).
    """

    tilt: float = 0.5
    spin: float = 5.0
    precession: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.tilt < np.pi:
            raise ValueError(f"tilt must lie between 0 and pi rad: an upright top stays as it is; got {self.tilt}")

    @cached_property
    def _constants(self) -> tuple[float, float, Array, float]:
        """Lz, L3, the roots (3,), and the phase at t = 0."""
        from scipy.special import ellipk

        u, L3 = np.cos(self.tilt), 0.5 * self.spin
        Lz = self.precession * (1 - u**2) + L3 * u
        e = 0.5 * self.precession**2 * (1 - u**2) + u
        # f(u) = 2 u^3 - (2 e + L3^2) u^2 + (2 Lz L3 - 2) u + 2 e - Lz^2; u is a root of it
        rest = np.array([2.0, 2.0 * u - (2 * e + L3**2), 0.0])
        rest[2] = rest[1] * u + 2 * Lz * L3 - 2
        others = np.sort(np.roots(rest).real)
        roots = np.sort([u, *others])
        m = (roots[1] - roots[0]) / (roots[2] - roots[0])
        return float(Lz), L3, roots, 0.0 if u == roots[0] else float(ellipk(m))

    def _nod(self, t: Any) -> tuple[Array, Array]:
        """u and u' at times t."""
        from scipy.special import ellipj

        _, _, (u1, u2, u3), phase = self._constants
        p, m = np.sqrt((u3 - u1) / 2), (u2 - u1) / (u3 - u1)
        sn, cn, dn, _ = ellipj(p * np.asarray(t) + phase, m)
        return u1 + (u2 - u1) * sn**2, 2 * (u2 - u1) * p * sn * cn * dn

    def state(self, t: float) -> Array:
        """y (13,): the tip rests in the origin."""
        Lz, L3, _, _ = self._constants

        def precession(t: Any) -> Array:
            u = self._nod(t)[0]
            return np.asarray((Lz - L3 * u) / (1 - u**2))

        def own(t: Array) -> Array:
            return np.asarray(self.spin - precession(t) * self._nod(t)[0])

        u, du = self._nod(t)
        phi, psi, sine = summed(precession, t), summed(own, t), np.sqrt(1 - u**2)
        attitude = chained(turn(Z, phi), turn(Y, float(np.arccos(u))), turn(Z, psi))
        rate, nod = float(precession(t)), float(-du / sine)
        across = np.array([-rate * sine, nod])  # before the turn about the own axis: omega in the frame of the nod
        c, s = np.cos(psi), np.sin(psi)
        w = [c * across[0] + s * across[1], -s * across[0] + c * across[1], self.spin]
        return np.concatenate([np.zeros(3), attitude, np.zeros(3), w])


def kept(system: RigidBodies, axes: Any = (0, 1, 2)) -> dict[str, Callable[[float, Array], float]]:
    """Energy, and the angular momentum in the world about the axes that keep it."""

    def about(axis: int) -> Callable[[float, Array], float]:
        return lambda t, y: float(world_momentum(system, y)[..., axis].sum())

    return {"energy": system.energy, **{f"L_{'xyz'[axis]}": about(axis) for axis in axes}}


def world_momentum(system: RigidBodies, y: Array) -> Array:
    """R I omega (B,3), the own angular momentum of each body in the world."""
    frame = system.frame
    own = frame.spins(system.momentum(y[system.width :]))
    return rotation.rotate(rotation.normalised(frame.turns(y[: system.width])), own)


@lru_cache(maxsize=1)
def free_top() -> Problem:
    """A body of moments 1, 2, 3 kg m^2 tumbles about its largest for two wobbles: all of Euler's equations."""
    top = FreeTop((1.0, 2.0, 3.0), (0.6, 0.4, 1.0))
    system = RigidBodies([1.0], np.diag(top.moments))
    known = {"exact": top.state, "invariants": kept(system)}
    return Problem("free-top", system, top.state(0.0), 7.3, **known, references=(DOP853, LSODA))  # type: ignore


@lru_cache(maxsize=1)
def heavy_top() -> Problem:
    """A top let go at 0.5 rad nods and precesses: a weight on the axis, the counterforce in the tip."""
    top = HeavyTop()
    weight, support = (
        Attached(_steady(name, force), [0], [place])
        for name, force, place in (("weight", -1.0, Z), ("tip", 1.0, 0 * Z))
    )
    system = RigidBodies([1.0], np.diag([1.0, 1.0, 0.5]), [weight, support])
    known = {"exact": top.state, "invariants": kept(system, (2,))}
    return Problem("heavy-top", system, top.state(0.0), 5.3, **known, references=(DOP853, LSODA))  # type: ignore


def _steady(name: str, upward: float) -> Field:
    """A constant force along z, N."""
    return Field(
        lambda x: np.broadcast_to(upward * Z, x.shape),
        lambda x: np.zeros((*x.shape, 3)),
        lambda x: -upward * x[:, 2],
        name=name,
    )
