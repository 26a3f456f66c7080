"""Third verdict: does the gradient point downhill?

A derivative can be right and useless.  Over a long horizon norm(dx_T/dx_0) may grow until no digit is left; where the
objective jumps, the derivative knows nothing of the jumps.  So the growth is measured, and along the steepest
direction the objective is smoothed over a small distance: its slope from values must be the mean of the derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array, as_positive
from dsim.studies.smoothing import Slopes, by_quadrature
from dsim.studies.verdicts.simulator import Simulator

SIGMA = 0.01  # of the size of x: the distance smoothed over
NODES = 61
PROBES = 2  # random objectives for the norm
TIMES = 4
LEAST_DIGITS = 3.0


@dataclass(frozen=True, eq=False)
class DescentVerdict:
    """verdict: downhill; biased, the mean of the derivatives is not the slope; useless, a step of that length
    against the gradient hardly lowers the objective; chaotic, fewer than three digits are left; unclear, the program
    or its gradient is not finite within six of those lengths.

    t (K,) s; growth (K,): an estimate of norm(dy_T/dy_0), Frobenius.  rate: its exponential rate over the second
    half, 1/s.  digits: what round-off leaves, -log10(eps * growth) with the growth in sizes of x over the size of y, so
    that units do not count.  slope: of the objective at x along the steepest direction, per size of x; slopes: the
    smoothed ones.
    """

    verdict: str
    t: Array
    growth: Array
    rate: float
    digits: float
    slope: float
    slopes: Slopes
    sigma: float

    def __str__(self) -> str:
        grown = f"growth {self.growth[-1]:.1e}, {self.digits:.0f} digits left"
        if self.verdict == "downhill":
            return f"downhill: slope {self.slope:.3g}, smoothed {self.slopes.smoothed:.3g}; {grown}"
        if self.verdict == "chaotic":
            return f"chaotic: {grown}"
        told = f"mean of gradients {self.slopes.mean:.3g}, smoothed {self.slopes.smoothed:.3g}"
        return f"{self.verdict}: {told}; {grown}"


def judge_descent(
    simulator: Simulator, w: Array | None = None, sigma: float = SIGMA, seed: int = 0, nodes: int = NODES
) -> DescentVerdict:
    """Verdict 3 on the gradient of w . y; sigma: how far to smooth, in sizes of the blocks of x."""
    sigma = float(as_positive("sigma", sigma, ()))
    w = simulator.weights(seed) if w is None else w
    t, growth, relative, eps = _growth(simulator, sigma, seed)
    digits = _digits(relative, eps)
    rate = _rate(t, growth)
    direction = simulator.pulled(w) * simulator.scale
    slope = float(np.linalg.norm(direction))
    if not np.isfinite(slope) or slope == 0.0:
        empty = Slopes(np.nan, np.nan, np.nan, np.nan)
        return DescentVerdict("useless", t, growth, rate, digits, slope, empty, sigma)
    direction = simulator.scale * direction / slope

    def line(s: Array) -> tuple[Array, Array]:
        places = [simulator.x + length * direction for length in s]
        values = [float(simulator.state(x) @ w) for x in places]
        return np.array(values), np.array([simulator.pulled(w, x) @ direction for x in places])

    slopes = by_quadrature(line, sigma, nodes)
    return DescentVerdict(_word(digits, slope, slopes), t, growth, rate, digits, slope, slopes, sigma)


def _word(digits: float, slope: float, slopes: Slopes) -> str:
    if not digits >= LEAST_DIGITS:
        return "chaotic"
    if not np.isfinite([slopes.smoothed, slopes.mean]).all():
        return "unclear"
    if slopes.biased:
        return "biased"
    return "downhill" if slopes.smoothed > max(0.05 * slope, slopes.smoothed_error) else "useless"


def _growth(simulator: Simulator, sigma: float, seed: int) -> tuple[Array, Array, float, float]:
    """(t, norm(dy_T/dy_0), its largest in sizes of x and y, eps): the mean over random objectives w of |w^T dy/dy0|^2
    is the Frobenius norm squared."""
    places = np.concatenate([simulator.blocks[name] for name in simulator.start])
    y: Any = simulator.state(simulator.x)
    counts = np.unique(np.linspace(1, simulator.steps, TIMES).round().astype(int))
    rng = np.random.default_rng(seed + 1)
    probes = np.ones((1, 1)) if y.size == 1 else rng.choice([-1.0, 1.0], size=(min(PROBES, y.size), y.size))
    pulled = np.array([[simulator.pulled(w, steps=int(n))[places] for w in probes] for n in counts])
    scaled = pulled * simulator.scale[places]
    growth, relative = (np.sqrt((p**2).sum(axis=2).mean(axis=1)) for p in (pulled, scaled))
    size = _size(simulator, y, sigma * rng.choice([-1.0, 1.0], len(simulator.x)) * simulator.scale)
    return simulator.h * counts, growth, float(relative.max()) / size, float(np.finfo(y.dtype).eps)


def _size(simulator: Simulator, y: Array, change: Array) -> float:
    """The largest |y| at x and beside it, where it may be zero by chance."""
    states = np.stack([y, *(simulator.state(simulator.x + sign * change) for sign in (1.0, -1.0))])
    return float(np.abs(states[np.isfinite(states)]).max(initial=0.0)) or 1.0


def _digits(growth: float, eps: float) -> float:
    if not np.isfinite(growth):
        return 0.0
    return float(np.clip(-np.log10(eps * max(growth, 1.0)), 0.0, 16.0))


def _rate(t: Array, growth: Array) -> float:
    half = len(t) // 2
    usable = np.isfinite(growth[half:]) & (growth[half:] > 0)
    if usable.sum() < 2:
        return 0.0
    return float(np.polyfit(t[half:][usable], np.log(growth[half:][usable]), 1)[0])
