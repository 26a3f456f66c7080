"""Hard cases 6 and 7: equilibria that end at a fold, and equilibria that are none to rest in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Gravity, Springs
from dsim.gradients.quasistatic import Equilibrium, EquilibriumError, record
from dsim.solve.newton import NewtonResult, Status, newton
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal, near
from dsim.system import System

Find = Callable[..., Equilibrium]


def plain_newton(system: System, q: Array) -> NewtonResult:
    """f(q) = 0 by Newton's full steps: what a textbook does."""
    rest = np.zeros(system.n)
    return newton(
        lambda q: system.stage_residual(rest, 0.0, q, rest),
        lambda q: system.stiffness(0.0, q).matrix,
        q,
        globalize="none",
        max_iterations=30,
    )


# 6

REST = np.sqrt(1.25)  # m, of both bars
LIMIT = 2 * (REST ** (2 / 3) - 1) ** 1.5  # N: .0429143257, at the height sqrt(l0^(2/3) - 1) = .277880 m
HEIGHT = np.sqrt(REST ** (2 / 3) - 1)


def truss(load: float) -> System:
    """Von Mises' truss: two bars of 1 N/m from the supports (-1, 0) and (1, 0) to an apex that bears `load` N."""
    bars = Springs([(0, 1), (2, 1)], REST, 1.0)
    return System(np.ones(3), [bars, Gravity([0.0, -load])], dimension=2, fixed=[0, 2])


def apex_at(height: float) -> Array:
    """q (6,) m of the truss with its apex on the middle line at this height, m."""
    return np.array([-1.0, 0.0, 0.0, height, 1.0, 0.0])


def bearing(height: Array) -> Array:
    """The load in balance at an apex height, P = 2 k y (l0/l - 1)."""
    load: Array = 2 * height * (REST / np.sqrt(1 + height**2) - 1)
    return load


def softness(height: Array) -> Array:
    """dy/dP = 1 / (2 k (l0/l^3 - 1)): without bound at the fold, where l = l0^(1/3)."""
    slope: Array = 0.5 / (REST / (1 + height**2) ** 1.5 - 1)
    return slope


def limit_load(find: Find) -> tuple[float, float]:
    """The largest load borne with the apex up, by bisection of what `find` says, and the apex height there."""
    low, high, height = 0.0, 0.1, 0.5
    while high - low > 1e-13:
        load = 0.5 * (low + high)
        found = find(truss(load), apex_at(height))
        if found.status in (Status.CONVERGED, Status.SINGULAR) and found.q[3] > 0.1:
            low, height = load, float(found.q[3])
        else:
            high = load
    return low, height


def slope_by_load(equilibrium: Equilibrium) -> float:
    """dy/dP of the apex: minus the derivative by gravity's vertical entry, for an apex of 1 kg.  NaN at a fold."""
    try:
        return -float(equilibrium.linearize().jacobian("gravity.acceleration")[3, 1])
    except EquilibriumError:
        return np.nan


def _load_steps() -> tuple[Array, Array]:
    """Apex heights of plain Newton from load to load through the limit, 5 % a step."""
    loads, heights, q = LIMIT * np.arange(0.05, 1.2, 0.05), [], apex_at(0.5)
    for load in loads:
        q = plain_newton(truss(load), q).z
        heights.append(q[3])
    return loads, np.array(heights)


def von_mises_truss(full: bool = False, find: Find = record) -> HardCaseResult:
    """Half-width 1 m, rise 0.5 m, k = 1 N/m a bar, a load P on the apex.  At Pc = 2k(l0^(2/3) - 1)^(3/2) the two
    equilibria with the apex up meet and vanish: dy/dP ~ (1 - P/Pc)^(-1/2), and beyond there is only the inverted one.

    Plain Newton jumps there without a word, and its Jacobian looks harmless: the condition number at the fold
    itself stays near 1e8, since the height is known to the root of round-off only.
    """
    loads, heights = _load_steps()
    jump = float(np.abs(np.diff(heights)).max())
    fold = find(truss(LIMIT), apex_at(0.5))
    stiffness = fold.system.stiffness(0.0, fold.q).matrix[2:4, 2:4]
    condition = float(np.linalg.cond(stiffness))
    limit, height = limit_load(find)
    delta = 10.0 ** -np.arange(3, 9.1, 0.5)
    rests = [find(truss(LIMIT * (1 - d)), apex_at(0.5)) for d in delta]
    slopes = np.array([slope_by_load(rest) for rest in rests])
    law = float(np.abs(slopes / softness(np.array([rest.q[3] for rest in rests])) - 1).max())
    exponent = float(np.polyfit(np.log(delta), np.log(np.abs(slopes)), 1)[0])
    y = np.linspace(-0.75, 0.5, 200)
    x = np.log10(delta)
    return HardCaseResult(
        (
            at_least("plain Newton, load by load", "largest jump of the apex (m)", jump, 0.5),
            at_most("test cond > 1e12", "condition number at the fold: it never fires", condition, 1e12),
        ),
        (
            near("bisection", "limit load (N)", limit, LIMIT, 1e-6 * LIMIT),
            near("bisection", "apex height at the fold (m)", height, HEIGHT, 5e-7),
            equal("quasistatic", 'status "singular" at the fold', float(fold.status is Status.SINGULAR), 1),
            equal("quasistatic", "no number at the fold", float(np.isnan(slope_by_load(fold))), 1),
            at_most("quasistatic", "dy/dP against its closed form, relative", law, 1e-9),
            near("quasistatic", "exponent of dy/dP ~ (1 - P/Pc)^s", exponent, -0.5, 0.01),
        ),
        (
            Panel(
                "Plain Newton, load by load", "apex height (m)", "load (N)",
                (Curve("equilibria", y, bearing(y)), Curve("Newton", heights, loads, True)),
                f"jumps by {jump:.2f} m, unnoticed",
            ),
            Panel(
                "Quasistatic: a status at the fold", "log10(1 - P/Pc)", "|dy/dP| (m/N)",
                (Curve("power -1/2", x, np.abs(slopes[-1]) * (delta / delta[-1]) ** -0.5),
                 Curve("quasistatic", x, np.abs(slopes), True)),
                f'at P = Pc: "{fold.status}"', "log",
            ),
        ),
        (f"jumps {jump:.2f} m", f"Pc {abs(limit / LIMIT - 1):.0e}, slope {exponent:.3f}", "1e-6, -.50+-.01"),
    )  # fmt: skip


# 7


@dataclass(frozen=True)
class Hinge:
    """A torsion spring at every coordinate: torque -kappa theta, N m; energy kappa theta^2/2."""

    stiffness: float
    name: str = "hinge"
    parameters = ("stiffness",)
    symmetric = True

    def force(self, t: float, q: Array, v: Array) -> Array:
        return -self.stiffness * q

    def energy(self, t: float, q: Array) -> float:
        return 0.5 * float(self.stiffness * (q @ q))

    def dq(self, t: float, q: Array, v: Array) -> Array:
        return -self.stiffness * np.eye(len(q))

    def dtheta(self, t: float, q: Array, v: Array) -> Array:
        return -q[:, None]


@dataclass(frozen=True)
class DeadLoad:
    """A load P on top of an upright strut of length L: torque P L sin(theta); energy P L cos(theta)."""

    force_down: float
    length: float
    name: str = "load"
    parameters = ("force_down",)
    symmetric = True

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self.force_down * self.length * np.sin(q)

    def energy(self, t: float, q: Array) -> float:
        return float(self.force_down * self.length * np.cos(q).sum())

    def dq(self, t: float, q: Array, v: Array) -> Array:
        return np.diag(self.force_down * self.length * np.cos(q))

    def dtheta(self, t: float, q: Array, v: Array) -> Array:
        return self.length * np.sin(q)[:, None]


def strut(load: float) -> System:
    """A rigid strut of 1 m on a hinge of 1 N m, in one coordinate: its angle from the vertical."""
    return System([1.0], [Hinge(1.0), DeadLoad(load, 1.0)], dimension=1)


def leaning(load: float) -> float:
    """theta of theta/sin(theta) = P L/kappa > 1, by bisection."""
    from scipy.optimize import brentq

    return float(brentq(lambda angle: angle - load * np.sin(angle), 1e-3, np.pi, xtol=1e-15))


def hinged_strut(full: bool = False, find: Find = record) -> HardCaseResult:
    """kappa theta = P L sin(theta) at P L/kappa = 1.1.  Upright is an equilibrium, and no place to rest: there the
    energy has its maximum.  Newton asks for a zero of the force alone and stays, or even goes there."""
    load, system = 1.1, strut(1.1)
    truth = leaning(load)
    stays, goes = (plain_newton(system, np.array([start])) for start in (0.0, 0.2))
    curvature = float(system.stiffness(0.0, stays.z).matrix[0, 0])
    rest, top = find(system, [0.0]), find(system, [0.0], kicks=0)
    try:
        slope = float(rest.linearize().jacobian("load.force_down")[0, 0])
    except EquilibriumError:
        slope = np.nan
    exact = np.sin(truth) / (1 - load * np.cos(truth))
    at_the_fork = find(strut(1.0), [0.0])
    loads = np.linspace(0.8, 1.5, 29)
    found = [find(strut(P), [0.0]) for P in loads]
    angles = np.array([e.q[0] if e.status is Status.CONVERGED else np.nan for e in found])
    branch = np.linspace(1.0005, 1.5, 60)
    angle = np.linspace(-1.3, 1.3, 101)
    energy = np.array([system.potential(0.0, np.array([a])) for a in angle]) - load
    ends = np.array([stays.z[0], goes.z[0]])
    return HardCaseResult(
        (
            equal("plain Newton from 0", "angle it says to have converged to", float(stays.z[0]), 0),
            at_most("plain Newton from 0.2", "angle it says to have converged to", abs(float(goes.z[0])), 1e-8),
            at_most("upright", "curvature of the energy: a maximum (N m)", curvature, -0.05),
        ),
        (
            near("quasistatic from 0", "angle", float(rest.q[0]), truth, 1e-8),
            near("quasistatic from 0", "angle, against the document's digits", float(rest.q[0]), 0.74898664, 1e-8),
            equal("quasistatic from 0", "converged", float(rest.status is Status.CONVERGED), 1),
            equal("without a kick", 'status "unstable"', float(top.status is Status.UNSTABLE), 1),
            equal("at P L/kappa = 1", 'status "singular"', float(at_the_fork.status is Status.SINGULAR), 1),
            near("quasistatic from 0", "dtheta/dP (rad/N)", slope, exact, 1e-8 * exact),
        ),
        (
            Panel("Plain Newton", "angle (rad)", "energy - that upright (J)",
                  (Curve("energy", angle, energy), Curve("ends, from 0 and 0.2", ends, 0 * ends, True)),
                  "climbs to the top"),
            Panel("Quasistatic: kicked downhill", "P L / kappa", "angle (rad)",
                  (Curve("leaning", branch, np.array([leaning(P) for P in branch])),
                   Curve("unstable", np.array([1.0, 1.5]), np.zeros(2)),
                   Curve("quasistatic", loads, angles, True)),
                  f'at 1: "{at_the_fork.status}"'),
        ),
        ("stays at 0", f"{rest.q[0]:.8f}", "1e-8"),
    )  # fmt: skip
