"""The slope a randomized objective has, and the mean of the slopes a program reports: with jumps they differ.

For f on a line and s ~ N(0, sigma^2), F(c) = E f(c + s) has

    F'(c) = E [ f(c + s) s ] / sigma^2                       (zeroth order: values alone)
          = E [ f'(c + s) ]  + sum of jumps, each weighed by the normal density at its place,

so the mean of exact derivatives leaves out what the jumps contribute (Suh, Simchowitz, Zhang, Tedrake 2022, "Do
differentiable simulators give better policy gradients?").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dsim.arrays.checks import Array, as_count, as_positive

REACH = 6.0  # standard deviations the quadrature covers; beyond lies 2e-9 of the normal distribution

Line = Callable[[Array], tuple[Array, Array]]  # s (n,) -> (f (n,), f' (n,))


@dataclass(frozen=True)
class Slopes:
    """Of a randomized objective: from values, and as the mean of derivatives, each with an error estimate."""

    smoothed: float
    smoothed_error: float
    mean: float
    mean_error: float

    @property
    def bias(self) -> float:
        """What the mean of derivatives is off by."""
        return self.mean - self.smoothed

    @property
    def biased(self) -> bool:
        """Whether that is more than three error estimates, and a hundredth of the slope."""
        doubt = 3 * (self.smoothed_error + self.mean_error)
        return not abs(self.bias) <= doubt + 0.01 * max(abs(self.smoothed), abs(self.mean))


def by_quadrature(line: Line, sigma: float, nodes: int = 97) -> Slopes:
    """Trapezoidal rule over +- 6 sigma; the error estimate is the change from two and three times the spacing.

    nodes: 1 more than a multiple of 6.  For smooth f the rule is good to 1e-7; a jump is placed to within a spacing.
    """
    sigma, nodes = float(as_positive("sigma", sigma, ())), as_count("nodes", nodes, 7)
    if nodes % 6 != 1:
        raise ValueError(f"nodes must be 1 more than a multiple of 6; got {nodes}")
    s = sigma * np.linspace(-REACH, REACH, nodes)
    f, slope = line(s)
    weights = np.exp(-0.5 * (s / sigma) ** 2)
    middle = f[nodes // 2]  # E[s] = 0: taking f(c) off changes nothing but round-off

    def means(every: int) -> tuple[float, float]:
        part = weights[::every]
        values = (f[::every] - middle) * s[::every] / sigma**2
        return float(part @ values / part.sum()), float(part @ slope[::every] / part.sum())

    (smoothed, mean), *coarser = means(1), means(2), means(3)
    errors = np.abs(np.array(coarser) - [smoothed, mean]).max(axis=0)
    return Slopes(smoothed, float(errors[0]), mean, float(errors[1]))


def by_sampling(line: Line, sigma: float, samples: int = 10_000, seed: int = 0) -> Slopes:
    """Monte Carlo with antithetic pairs; the errors are standard errors of the means."""
    sigma, samples = float(as_positive("sigma", sigma, ())), as_count("samples", samples, 2)
    s = sigma * np.random.default_rng(seed).normal(size=samples)
    (ahead, slope_ahead), (behind, slope_behind) = line(s), line(-s)
    values = (ahead - behind) * s / (2 * sigma**2)
    slopes = (slope_ahead + slope_behind) / 2
    root = np.sqrt(samples)
    return Slopes(
        float(values.mean()), float(values.std(ddof=1) / root), float(slopes.mean()), float(slopes.std(ddof=1) / root)
    )


# The ball over a wall: every derivative is exact, and their mean points the wrong way by 98 %


@dataclass(frozen=True)
class Wall:
    """A ball leaves (0, 0) at v0 (m/s) under the angle theta; a wall of `height` m stands at `place` m.

    It lands at R = v0^2 sin(2 theta) / g, or drops at the wall if it does not clear it; J = -(where it lands)^2.
    """

    v0: float = 1.0
    place: float = 0.06
    height: float = 0.02
    g: float = 9.81

    def landing(self, theta: Array) -> tuple[Array, Array]:
        """Where the ball lands (m) and the derivative by theta; 0 at the wall."""
        reach = self.v0**2 * np.sin(2 * theta) / self.g
        high = self.place * np.tan(theta) - self.g * self.place**2 / (2 * (self.v0 * np.cos(theta)) ** 2)
        stopped = (reach >= self.place) & (high < self.height)
        slope = 2 * self.v0**2 * np.cos(2 * theta) / self.g
        return np.where(stopped, self.place, reach), np.where(stopped, 0.0, slope)

    def line(self, theta: float) -> Line:
        """J and dJ/dtheta around an angle."""

        def objective(s: Array) -> tuple[Array, Array]:
            x, slope = self.landing(theta + s)
            return -(x**2), -2 * x * slope

        return objective
