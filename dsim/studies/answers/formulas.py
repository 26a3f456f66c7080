"""Single derivatives in closed form: of chaos, of a particle with drag, of a throw over a wall."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np

from dsim.arrays.checks import Array
from dsim.studies.answers.document import Document, Item, certified, evidence, header
from dsim.studies.horizons import ANGLE, damped, damped_slope, logistic_state, logistic_truth
from dsim.studies.smoothing import Wall

CHAOS_STEPS = 20  # beyond, round-off has grown to more than 1e-10 of the derivative
DRAGS = (0.0, 1.0, 3.0, 10.0)
CENTRE, SIGMA = 0.6932038, 0.1


def items() -> list[Item]:
    """All of them."""
    return [
        Item("logistic-map", 1, 0, f"{CHAOS_STEPS} steps", (1e-9, 1e-9), "closed form", logistic),
        Item("drag-bounds-growth", 2, 0, "999 steps", (1e-12, 1e-12), "geometric series", drag),
        Item("ball-over-a-wall", 1, 0, "one throw", (1e-12, 1e-8), "two integrals", wall),
    ]


def logistic() -> Document:
    """x -> 4 x (1 - x): the derivative doubles its digits lost every step."""
    states, slopes = logistic_truth(CHAOS_STEPS)
    run = logistic_state(float(states[0]), CHAOS_STEPS)
    product = np.concatenate([[1.0], np.cumprod(4 * (1 - 2 * run[:-1]))])
    return _document(
        "logistic-map",
        "A chaotic map: dx[n]/dx[0] is exact and grows as 2^n",
        ("x[n+1] = 4 x[n] (1 - x[n]), x[0] = sin(a)^2", "x[n] = sin(2^n a)^2",
         "dx[n]/dx[0] = 2^n sin(2^(n+1) a) / sin(2 a)"),
        {"a": ANGLE, "x0": float(states[0]), "steps": CHAOS_STEPS},
        {"states": states, "gradient": {"x0": slopes}},
        (_gap("closed form against the map in floats", states, run),
         _gap("closed form against the chain rule in floats", slopes, product), (1e-9, 1e-9)),
    )  # fmt: skip


def drag() -> Document:
    """999 updates of v *= b, x += h v: dx/dv0 stays below 1/c."""
    h, updates = 1e-3, 999
    series = np.array([damped_slope(c, h, updates, exponential=False) for c in DRAGS])
    exponential = np.array([damped_slope(c, h, updates) for c in DRAGS])
    w = np.array([1.0, 0.0])
    program = np.array([damped(c, h, updates).pulled(w)[0] for c in DRAGS])
    ends = np.array([damped(c, h, updates).state(np.array([1.0]))[0] for c in DRAGS])
    return _document(
        "drag-bounds-growth",
        "A particle with drag c: dx/dv0 after 999 updates of 1 ms never exceeds 1/c",
        ("v = b v, then x = x + h v, from x = 0 and v = v0 = 1", "b = 1 - c h (euler), or b = exp(-c h) (exponential)",
         "dx/dv0 = h b (1 - b^updates) / (1 - b), h updates for c = 0"),
        {"h": h, "updates": updates, "c": np.array(DRAGS)},
        {"states": series, "gradient": {"euler": series, "exponential": exponential}},
        (_gap("series against dsim's symplectic Euler", series, ends),
         _gap("series against dsim's adjoint", series, program), (1e-12, 1e-12)),
    )  # fmt: skip


def wall() -> Document:
    """Every derivative is exact, and their mean is off by 98 %."""
    thrown = Wall()
    smoothed, mean, jumps = smoothed_slope(thrown, CENTRE, SIGMA)
    theta = np.array([0.3, 0.72, 0.9, 1.1])
    landing, slope = thrown.landing(theta)
    high = thrown.v0**2 * 2 * np.sin(theta) * np.cos(theta) / thrown.g  # sin(2 theta) otherwise
    return _document(
        "ball-over-a-wall",
        "A throw over a wall: the slope of the smoothed objective, and the mean of the exact derivatives",
        ("R = v0^2 sin(2 theta) / g",
         "height at the wall: place tan(theta) - g place^2 / (2 (v0 cos(theta))^2)",
         "x = place if R >= place and that height < height, else R;  J = -x^2", "angle ~ N(centre, sigma^2)",
         "smoothed = d E[J] / d centre;  mean = E[dJ/dangle];  gradient.x = dx/dtheta at the angles theta"),
        {"v0": thrown.v0, "place": thrown.place, "height": thrown.height, "g": thrown.g, "centre": CENTRE,
         "sigma": SIGMA, "theta": theta},
        {"states": landing, "gradient": {"x": slope, "smoothed": smoothed, "mean": mean}},
        (_gap("two forms of the sine", landing, np.where(landing == thrown.place, landing, high)),
         _gap("integral of values against integral of slopes plus jumps", np.array([smoothed]),
              np.array([mean + jumps])), (1e-12, 1e-8)),
    )  # fmt: skip


def smoothed_slope(wall: Wall, centre: float, sigma: float) -> tuple[float, float, float]:
    """(d E[J]/d centre from values, E[dJ/dtheta], what the jumps of J add to the latter) by adaptive quadrature."""
    from scipy.integrate import quad
    from scipy.optimize import brentq

    def density(theta: float) -> float:
        return float(np.exp(-0.5 * ((theta - centre) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi)))

    def clearance(theta: float) -> float:
        drop = wall.g * wall.place**2 / (2 * (wall.v0 * np.cos(theta)) ** 2)
        return float(wall.place * np.tan(theta) - drop - wall.height)

    def objective(theta: float) -> tuple[float, float]:
        value, slope = wall.line(theta)(np.zeros(1))
        return float(value[0]), float(slope[0])

    edges = [brentq(clearance, 0.5, 0.9, xtol=1e-15), brentq(clearance, 1.0, 1.4, xtol=1e-15)]
    short = 0.5 * np.arcsin(wall.place * wall.g / wall.v0**2)  # where the range is the wall's place: kinks
    ends = [centre - 10 * sigma, *sorted([short, *edges, np.pi / 2 - short]), centre + 10 * sigma]

    def integral(f: Callable[[float], float]) -> float:
        parts = itertools.pairwise(ends)
        return float(sum(quad(f, a, b, epsabs=1e-13, epsrel=1e-12, limit=200)[0] for a, b in parts))

    values = integral(lambda s: objective(s)[0] * (s - centre) / sigma**2 * density(s))
    mean = integral(lambda s: objective(s)[1] * density(s))
    tiny = 1e-12
    jumps = sum((objective(e + tiny)[0] - objective(e - tiny)[0]) * density(e) for e in edges)
    return values, mean, float(jumps)


def _document(
    name: str,
    description: str,
    formula: tuple[str, ...],
    given: Document,
    answer: Document,
    certificate: tuple[Document, Document, tuple[float, float]],
) -> Document:
    """certificate: the evidence for states and gradient, and the tolerance of both."""
    states, gradient, tolerance = certificate
    found = header(name, "formula", description)
    found |= {
        "equations": list(formula),
        "given": given,
        "answer": answer,
        "certificate": {"states": [states], "gradient": [gradient]},
        "tolerance": {"states": np.full(len(answer["states"]), tolerance[0]), "gradient": tolerance[1]},
    }
    return certified(found)


def _gap(how: str, a: Array, b: Array) -> Document:
    return evidence(f"{how}, relative", float(np.abs(a - b).max() / np.abs(a).max()))
