"""Hard cases 1 to 5: springs that are stiff, too quick, of no length or compressed, and a Newton that overshoots."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from dsim.arrays.checks import Array
from dsim.effects import Field, Gravity, Springs
from dsim.simulation import record
from dsim.solve.newton import Globalize, NewtonResult, Status, newton
from dsim.steppers import BackwardEuler, ForwardEuler, SymplecticEuler
from dsim.steppers.stepper import Stepper
from dsim.studies.hard_cases.model import Curve, HardCaseResult, Panel, at_least, at_most, equal, near
from dsim.system import System

BACKWARD_EULER, SYMPLECTIC_EULER = BackwardEuler(), SymplecticEuler()


def oscillator(stiffness: float) -> System:
    """One point of 1 kg on a line under f = -k x, with energy v^2/2 + k x^2/2."""
    field = Field(
        lambda x: -stiffness * x,
        lambda x: np.full((len(x), 1, 1), -stiffness),
        lambda x: stiffness * x[:, 0] ** 2 / 2,
    )
    return System([1.0], [field], dimension=1)


# 1


def stiff_spring(full: bool = False, survivor: Stepper = BACKWARD_EULER) -> HardCaseResult:
    """k = 1e8 N/m, m = 1 kg, h = 0.01 s.  Forward Euler multiplies z = w x - i v by (1 + i h w) each step, 100-fold;
    backward Euler divides by it, so its energy falls by 1/(1 + h^2 w^2) a step.

    k |x_n| is the first number to overflow, with x_n = Re (1 + i h w)^n: the step after that one fails.
    """
    k, h = 1e8, 0.01
    system, y0 = oscillator(k), [1.0, 0.0]
    naive = record(ForwardEuler(), system, y0, h, 200)
    n = np.arange(1, 200)
    root = 1 + 1j * h * np.sqrt(k)
    size = n * np.log10(np.abs(root)) + np.log10(np.abs(np.cos(n * np.angle(root))))  # log10 |x_n|
    due = int(n[np.log10(k) + size > np.log10(np.finfo(float).max)][0]) + 1
    failed = len(naive.t)

    good = record(survivor, system, y0, h, 40)
    energy = np.array([system.energy(0.0, y) for y in good.y])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(energy[1:] / energy[:-1] * (1 + h**2 * k) - 1).max()
    worst = float(ratio) if len(good.t) == 41 else np.inf
    steps, law = np.arange(len(energy)), (1 + h**2 * k) ** -np.arange(41.0)
    return HardCaseResult(
        (
            equal("forward Euler", "does not overflow (0 = it does)", float(naive.status is not Status.NOT_FINITE), 0),
            equal("forward Euler", "the step that overflows", failed, due),
        ),
        (at_most("backward Euler", "energy ratio of a step, relative to 1/(1 + h^2 w^2)", worst, 1e-10),),
        (
            Panel(
                "Forward Euler", "step", "|x| (m)", (Curve("forward Euler", np.arange(failed), np.abs(naive.q[:, 0])),),
                f"overflows in step {failed}", "log",
            ),
            Panel(
                "Backward Euler", "step", "energy / start energy",
                (Curve("$(1 + h^2 w^2)^{-n}$", np.arange(41), law), Curve("measured", steps, energy / energy[0], True)),
                f"each ratio right to {worst:.0e}", "log",
            ),
        ),
        (f"overflow, step {failed}", f"{worst:.1e}", "ratio to 1e-10"),
    )  # fmt: skip


# 2


def stability_warning(system: System, q: Array, h: float) -> str:
    """What to say before an explicit symplectic step of size h, or "" when h w < 2.

    w is the highest frequency of the linearized system, w^2 the largest eigenvalue of M^-1/2 (-df/dq) M^-1/2.
    At h w = 2 itself both roots of the step are -1 and errors grow linearly: that warns too.
    """
    scale = 1 / np.sqrt(system.masses)
    stiffness = -system.dq(0.0, q, np.zeros(system.n)).toarray()
    stiffness = scale[:, None] * (stiffness + stiffness.T) / 2 * scale
    reach = h * float(np.sqrt(max(0.0, np.linalg.eigvalsh(stiffness).max())))
    return f"h w = {reach:.4g} >= 2: unstable; take h < {2 * h / reach:.3g} s" if reach >= 2 else ""


def edge_of_stability(full: bool = False, survivor: Stepper = SYMPLECTIC_EULER) -> HardCaseResult:
    """Symplectic Euler, w = 1, h w = 1.99 against 2.01, 1e4 steps.  It conserves
    v^2/2 + w^2 x^2/2 - h w^2 x v/2, hence |x| <= 1/sqrt(1 - (h w/2)^2) from x = 1, v = 0."""
    system, y0 = oscillator(1.0), [1.0, 0.0]
    over = record(SYMPLECTIC_EULER, system, y0, 2.01, 10_000)
    h = 1.99
    run = record(survivor, system, y0, h, 10_000)
    x, v = run.q[:, 0], run.v[:, 0]
    largest, limit = float(np.abs(x).max()), 1 / np.sqrt(1 - (h / 2) ** 2)
    with np.errstate(over="ignore", invalid="ignore"):
        drift = float(np.abs((v**2 + x**2 - h * x * v) / 2 - 0.5).max() / 0.5)
    # |x| grows by the larger root of z^2 - (2 - h^2 w^2) z + 1 = 0 each step
    trace = 2 - 2.01**2
    growth = abs(trace) / 2 + np.sqrt(trace**2 / 4 - 1)
    seen = float(np.abs(over.q[1001, 0] / over.q[1000, 0]))
    rest = np.zeros(1)
    warned = [bool(stability_warning(system, rest, size)) for size in (1.99, 2.0, 2.01)]
    failed, shown = len(over.t) if over.status is Status.NOT_FINITE else np.inf, 400
    return HardCaseResult(
        (
            at_most("h w = 2.01", "the step that overflows", failed, 1e4),
            near("h w = 2.01", "growth of |x| a step", seen, growth, 1e-9),
        ),
        (
            equal("h w = 1.99", "steps completed", len(run.t) - 1, 10_000),
            near("h w = 1.99", "largest |x| (m)", largest, limit, 1e-3),
            at_most("h w = 1.99", "drift of the modified energy / (w^2/2)", drift, 1e-12),
            equal("warning", "given at h w = 2 and 2.01, not at 1.99", float(warned == [False, True, True]), 1),
        ),
        (
            Panel(
                "h w = 2.01", "step", "|x| (m)",
                (Curve("symplectic Euler", np.arange(len(over.t)), np.abs(over.q[:, 0])),),
                f"overflows in step {failed}", "log",
            ),
            Panel(
                "h w = 1.99", "step", "x (m)",
                (
                    Curve("symplectic Euler", np.arange(shown), x[:shown], True),
                    Curve("bound $\\pm 1/\\sqrt{1 - (hw/2)^2}$", np.array([0, shown, np.nan, 0, shown]),
                          limit * np.array([1, 1, np.nan, -1, -1])),
                ),
                f"largest |x| in 10000 steps: {largest:.4f}",
            ),
        ),
        (f"overflow, step {failed}", f"max |x| {largest:.4f}", f"{limit:.4f}+-1e-3"),
    )  # fmt: skip


# 3


def textbook_pull(x: Array) -> Array:
    """-k (l - l0) x/l of a spring to the origin, k = 40 N/m, l0 = 1 m, as it stands in the textbook: 0/0 at x = 0."""
    length = np.linalg.norm(x, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        pull: Array = -40.0 * (length - 1) * x / length
    return pull


def library_springs() -> Springs:
    """The same spring from dsim: no direction, hence no force, where its ends coincide."""
    return Springs([(0, 1)], 1.0, 40.0)


def coincident_ends(full: bool = False, springs: Callable[[], Any] = library_springs) -> HardCaseResult:
    """A point of 1 kg starts in the hook of its spring (l0 = 1 m) and falls.  The direction x/l is 0/0 there."""
    gravity, h, steps = Gravity([0.0, -9.81]), 0.01, 200
    alone = System([1.0], [gravity, Field(textbook_pull)], dimension=2)
    naive = record(SYMPLECTIC_EULER, alone, np.zeros(4), h, steps)
    system = System([1.0, 1.0], [gravity, springs()], dimension=2, fixed=[0])
    run = record(SYMPLECTIC_EULER, system, np.zeros(8), h, steps)
    implicit = record(BackwardEuler(globalize="energy"), system, np.zeros(8), h, 20)
    q, v = np.zeros(4), np.zeros(4)
    spring: Any = system.effects[1]
    force = spring.force(0.0, q, v)
    parts = [np.atleast_1d(spring.energy(0.0, q)), spring.dq(0.0, q, v).toarray(), spring.dtheta(0.0, q, v).toarray()]
    finite = all(np.isfinite(part).all() for part in (*parts, *spring.vjp(0.0, q, v, np.ones(4))))
    # started from coincident ends the first step is free fall: v1 = h g exactly, since f = 0 there
    first = float(np.abs(run.v[1, 2:] - h * np.array([0.0, -9.81])).max()) if len(run.t) > 1 else np.inf
    failed, defined = len(naive.t), np.isfinite(textbook_pull(q[None, :2])).all()
    return HardCaseResult(
        (
            equal("textbook formula", "finite force at coincident ends", float(defined), 0),
            equal("textbook formula", "the step that is NaN", failed, 1),
        ),
        (
            equal("Springs", "largest |f| at coincident ends (N)", float(np.abs(force).max()), 0),
            equal("Springs", "energy, dq, dtheta and vjp finite", float(finite), 1),
            equal("symplectic Euler", "steps completed", len(run.t) - 1, steps),
            equal("backward Euler", "steps completed", len(implicit.t) - 1, 20),
            at_most("symplectic Euler", "first step against free fall (m/s)", first, 0.0),
        ),
        (
            Panel(
                "Textbook formula", "time (s)", "height (m)",
                (Curve("-k (l - $l_0$) x/l", naive.t, naive.q[:, 1], True), Curve("the motion", run.t, run.q[:, 3])),
                "0/0 = NaN in step 1: only the start can be drawn",
            ),
            Panel("Documented f = 0", "time (s)", "height (m)", (Curve("dsim Springs", run.t, run.q[:, 3]),)),
        ),
        ("NaN, step 1", f"f = {np.abs(force).max():g}, finite", "f = 0, finite"),
    )  # fmt: skip


# 4


class _Implicit(NamedTuple):
    """Backward Euler of a point of 1 kg on a spring to the origin, in its new position x: the minimum of
    Phi(x) = m |x - x~|^2 / (2 h^2) + U(x), with x~ = q + h v."""

    system: System
    ahead: Array  # x~
    h: float

    def whole(self, x: Array) -> Array:
        return np.concatenate([np.zeros(len(x)), x])

    def energy(self, x: Array) -> float:
        pull = float((x - self.ahead) @ (x - self.ahead)) / (2 * self.h**2)
        return pull + self.system.potential(0.0, self.whole(x))

    def residual(self, x: Array) -> Array:
        force = self.system.force(0.0, self.whole(x), np.zeros(2 * len(x)))
        inertia: Array = (x - self.ahead) / self.h**2
        return inertia - force[len(x) :]

    def matrix(self, x: Array) -> Array:
        return np.eye(len(x)) / self.h**2 + spring_matrix(self.system, self.whole(x))[len(x) :, len(x) :]


def spring_matrix(system: System, q: Array) -> Array:
    """K = d2U/dx2 (n,n), N/m, exact."""
    return -np.asarray(system.dq(0.0, q, np.zeros(system.n)).toarray())


def compressed_spring(full: bool = False, globalize: Globalize = "energy") -> HardCaseResult:
    """A spring held at half its rest length by its load of 50 N, k = 100 N/m, m = 1 kg, backward Euler, h = 0.2 s.

    The point drifts sideways at 0.5 m/s, and plain Newton sends it the other way, up to a saddle.
    K = k [(1 - l0/l) I + l0/l n n^T] has the eigenvalues k along and k (1 - l0/l) = -k across, so
    M + h^2 K is indefinite iff h^2 k/m (l0/l - 1) > 1: here that number is 4.
    """
    k, h = 100.0, 0.2
    effects = [Springs([(0, 1)], 1.0, k), Gravity([-k / 2, 0.0])]
    system = System([1.0, 1.0], effects, dimension=2, fixed=[0])
    q, v = np.array([0.5, 0.0]), np.array([0.0, 0.5])
    problem = _Implicit(system, q + h * v, h)
    _, naive_path = descend(problem, q, "none")
    good, path = descend(problem, q, globalize)
    step = -np.linalg.solve(problem.matrix(q), problem.residual(q))
    slope = float(problem.residual(q) @ step)
    heights, climbs = (np.array([problem.energy(x) for x in steps]) for steps in (path, naive_path))
    climb = float(np.diff(climbs).max())
    rise = float(np.diff(heights).max()) if len(heights) > 1 else np.inf
    fell = f"falls {len(heights) - 1} times"
    end = np.linalg.eigvalsh(problem.matrix(good.z)).min()
    stepper = record(BackwardEuler(globalize="energy"), system, np.concatenate([[0, 0], q, [0, 0], v]), h, 1)
    apart = float(np.abs(stepper.q[-1, 2:] - good.z).max()) if len(stepper.t) == 2 else np.inf
    return HardCaseResult(
        (
            equal("Cholesky of the exact matrix", "succeeds (0 = it fails)", float(has_cholesky(problem.matrix(q))), 0),
            at_least("plain Newton", "slope of the energy along the first step (J)", slope, 1e-3),
            at_least("plain Newton", "largest rise of the energy in an iteration (J)", climb, 1e-3),
        ),
        (
            at_most("spring", "eigenvalues of K, four kinds, relative to k", _eigenvalue_error(k), 1e-12),
            equal("spring", "indefinite iff h^2 k/m (l0/l - 1) > 1", float(_threshold_holds(k)), 1),
            equal("projected Newton", "converged", float(good.status is Status.CONVERGED), 1),
            at_most("projected Newton", "largest change of the energy in an iteration (J)", rise, 0.0),
            at_least("projected Newton", "smallest eigenvalue at its end: a minimum (N/m)", float(end), 1.0),
            at_most("BackwardEuler", "distance of its step from that minimum (m)", apart, 1e-8),
        ),
        _landscapes(problem, naive_path, path, slope),
        (f"climbs {climb:.2g} J", fell if rise < 0 else f"rises {rise:.1g} J", "energy falls"),
    )  # fmt: skip


def descend(problem: _Implicit, start: Array, globalize: Globalize) -> tuple[NewtonResult, list[Array]]:
    """Newton on the step, and the iterates it went through."""
    path: list[Array] = []

    def linearize(x: Array) -> Array:
        path.append(x.copy())
        return problem.matrix(x)

    how: Any = problem.energy if globalize == "energy" else globalize
    result = newton(problem.residual, linearize, start, tol=1e-10, globalize=how, max_iterations=30)
    # the last correction, once below 1e-8 m, changes the energy by less than its own round-off
    far = [x for x in path if np.abs(x - result.z).max() > 1e-8]
    return result, [*far, result.z]


def has_cholesky(matrix: Array) -> bool:
    """Whether a symmetric matrix is positive definite: its Cholesky factorization exists."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


def _eigenvalue_error(k: float) -> float:
    """Eigenvalues of K at l = l0/2 with one end fixed and with both free, in 2-D and 3-D, against {k, -k, ...}."""
    worst = 0.0
    for d in (2, 3):
        system = System([1.0, 1.0], [Springs([(0, 1)], 1.0, k)], dimension=d)
        direction = np.arange(1.0, d + 1) / np.linalg.norm(np.arange(1.0, d + 1))
        K = spring_matrix(system, np.concatenate([np.zeros(d), direction / 2]))
        fixed, free = [-k] * (d - 1) + [k], [-2 * k] * (d - 1) + [0] * d + [2 * k]
        for block, truth in ((K[d:, d:], fixed), (K, free)):
            worst = max(worst, float(np.abs(np.linalg.eigvalsh(block) - truth).max() / k))
    return worst


def _threshold_holds(k: float) -> bool:
    """M + h^2 K has a Cholesky factor just below h^2 k/m (l0/l - 1) = 1, and none just above; at three lengths."""
    system = System([1.0, 1.0], [Springs([(0, 1)], 1.0, k)], dimension=2, fixed=[0])
    found = []
    for length in (0.25, 0.5, 0.8):
        K = spring_matrix(system, np.array([0, 0, length, 0]))[2:, 2:]
        critical = 1 / (k * (1 / length - 1))  # h^2
        found.append([has_cholesky(np.eye(2) + factor * critical * K) for factor in (1 - 1e-9, 1 + 1e-9)])
    return found == [[True, False]] * 3


def _landscapes(problem: _Implicit, naive: list[Array], good: list[Array], slope: float) -> tuple[Panel, Panel]:
    ranges = ((0.35, 0.65, -0.15, 0.15), (-1.5, 1.1, -1.1, 1.5))  # the naive step is small: drawn larger
    panels = []
    notes = (f"the first step climbs towards a saddle: slope +{slope:.3g} J", "the energy falls in every iteration")
    titles = ("Plain Newton", "Projected, with line search")
    for title, path, note, (left, right, low, high) in zip(titles, (naive, good), notes, ranges, strict=True):
        x, y = np.linspace(left, right, 51), np.linspace(low, high, 51)
        heights = np.array([[problem.energy(np.array([a, b])) for a in x] for b in y])
        places = np.array(path)
        curves = (
            Curve("iterates", places[:, 0], places[:, 1], False),
            Curve("start", places[:1, 0], places[:1, 1], True),
            Curve("end", places[-1:, 0], places[-1:, 1], True),
        )
        panels.append(Panel(title, "x (m)", "y (m)", curves, note, contours=(x, y, heights), equal=True))
    return panels[0], panels[1]


# 5


def overshooting_newton(full: bool = False, globalize: Globalize = "energy") -> HardCaseResult:
    """min sqrt(1 + x^2), a smooth |x|.  Newton's step is x -> -x^3: 1 is a cycle, anything beyond diverges.

    The cycle repels: the distance from it triples each time, so round-off of 1e-16 leaves it after some thirty
    iterations, to either side.  The failure to be shown is that they are lost: twenty are the survivor's budget.
    From 1.1 the iterates grow until x^2 overflows; the gradient then reads 0, and plain Newton says "converged".
    """
    circling, circle = minimise(1.0, "none", 20)
    flying, flight = minimise(1.1, "none")
    law = max(abs(b + a**3) / abs(a) ** 3 for a, b in pairwise(flight[:6]))
    good = {start: minimise(start, globalize) for start in (1.0, 1.1, 100.0)}
    most = max(result.iterations for result, _ in good.values())
    far = max(abs(float(result.z[0])) for result, _ in good.values())
    done = all(result.status is Status.CONVERGED for result, _ in good.values())
    cycle = max(abs(abs(x) - 1) for x in circle)

    def curve(label: str, path: list[float]) -> Curve:
        return Curve(label, np.arange(len(path)), np.maximum(np.abs(path), 1e-17))

    return HardCaseResult(
        (
            equal("plain Newton from 1", "converged in 20 iterations", float(circling.status is Status.CONVERGED), 0),
            at_most("plain Newton from 1", "distance from the cycle +-1 in 20 iterations", cycle, 1e-6),
            equal("plain Newton from 1.1", "ends at the minimum", float(abs(flying.z[0]) < 1), 0),
            at_least("plain Newton from 1.1", "largest |x|", max(map(abs, flight)), 1e10),
            at_most("plain Newton from 1.1", "x -> -x^3, relative", law, 1e-9),
        ),
        (
            equal("line search", "converged from 1, 1.1 and 100", float(done), 1),
            at_most("line search", "most iterations", most, 20),
            at_most("line search", "largest |x| at the end", far, 1e-12),
        ),
        (
            Panel("Plain Newton", "iteration", "|x|", (curve("from 1.1", flight), curve("from 1", circle[:8])),
                  "from 1.1: x to $-x^3$; from 1: a cycle", "log"),
            Panel("Line search", "iteration", "|x|", tuple(curve(f"from {s:g}", p) for s, (_, p) in good.items()),
                  f"at most {most} iterations; exact 0 drawn at 1e-17", "log"),
        ),
        ("cycle; diverges", f"{most} its, |x| {far:.0e}", "20 its, 1e-12"),
    )  # fmt: skip


def minimise(start: float, globalize: Globalize, most: int = 50) -> tuple[NewtonResult, list[float]]:
    """Newton on d/dx sqrt(1 + x^2) = x/sqrt(1 + x^2), and the iterates it went through."""
    path: list[float] = []

    def linearize(x: Array) -> Array:
        path.append(float(x[0]))
        return np.array([[(1 + x[0] ** 2) ** -1.5]])

    def energy(x: Array) -> float:
        return float(np.sqrt(1 + x[0] ** 2))

    def residual(x: Array) -> Array:
        return x / np.sqrt(1 + x**2)

    how: Any = energy if globalize == "energy" else globalize
    result = newton(residual, linearize, np.array([start]), tol=1e-10, globalize=how, max_iterations=most)
    return result, [*path, float(result.z[0])]
