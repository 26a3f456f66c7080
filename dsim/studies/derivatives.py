"""Generated checks of kernels and effects: every derivative against differences of what it derives from."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.kernels.kernel import Kernel
from dsim.studies.check import Check
from dsim.system import System

# Extrapolated differences agree to 1e-10 or better on these samples; an analytic slip shows at 1e-2.
EXACT = 1e-8
# Derivatives that are differences are known to 1e-10 or so; differences of these, over steps of 1e-3, to 1e-7.
TWICE_DIFFERENCED = 1e-6


@dataclass(frozen=True)
class EffectExample:
    """An effect for the generated checks: make(rng, points, dimension) builds a generic one."""

    name: str
    make: Callable[[np.random.Generator, int, int], Any]


def directional(f: Callable[[Array], Array], x: Array, directions: Array) -> Array:
    """(df/dx) U by extrapolated central differences (`scipy.differentiate`), f: (n,) -> (m,), U (n,k); (m,k)."""
    from scipy.differentiate import derivative

    columns = []
    for direction in directions.T:

        def line(s: Array, direction: Array = direction) -> Array:
            return np.stack([f(x + value * direction) for value in np.ravel(s)], axis=-1).reshape(-1, *np.shape(s))

        found = derivative(line, 0.0, initial_step=0.02, order=8, maxiter=4, preserve_shape=True)
        columns.append(np.ravel(found.df))
    return np.stack(columns, axis=1)


def jacobian(f: Callable[[Array], Array], x: Array) -> Array:
    """df/dx, (m,n), by `directional`."""
    return directional(f, x, np.eye(len(x)))


def deviation(claimed: Any, measured: Array) -> float:
    """max |claimed - measured| relative to the largest measured entry (or 1, if all are smaller)."""
    claimed = claimed.toarray() if hasattr(claimed, "toarray") else np.asarray(claimed)
    if claimed.shape != measured.shape:
        return np.inf
    return float(np.abs(claimed - measured).max(initial=0.0) / max(1.0, np.abs(measured).max(initial=0.0)))


def verdict(subject: str, statement: str, measured: float, limit: float = EXACT) -> Check:
    """A check that passes when measured <= limit (NaN never does)."""
    return Check(subject, statement, bool(measured <= limit), measured, f"<= {limit:.0e}")


def check_kernel(kernel: Kernel, seed: int = 0) -> tuple[Check, ...]:
    """gradient, hessian and mixed against differences of the energy and the gradient; the hessian's symmetry."""
    x, theta = kernel.sample(np.random.default_rng(seed))
    count, width = len(x), x[0].size

    def per_element(values: Array) -> Array:
        """Derivatives of element e by element f's entries vanish for e != f: keep the diagonal blocks."""
        return np.stack([values[e, ..., e, :] for e in range(count)])

    energy = jacobian(lambda z: kernel.energy(z.reshape(x.shape), theta), x.ravel())
    slope = jacobian(lambda z: kernel.gradient(z.reshape(x.shape), theta).ravel(), x.ravel())
    by_theta = jacobian(lambda p: kernel.gradient(x, p.reshape(theta.shape)).ravel(), theta.ravel())
    gradient = per_element(energy.reshape(count, count, width))
    hessian = per_element(slope.reshape(count, width, count, width))
    mixed = per_element(by_theta.reshape(count, width, count, theta.shape[1]))
    claimed = kernel.hessian(x, theta).reshape(count, width, width)
    return (
        verdict(
            kernel.name, "gradient = d energy/dx", deviation(kernel.gradient(x, theta).reshape(count, -1), gradient)
        ),
        verdict(kernel.name, "hessian = d gradient/dx", deviation(claimed, hessian)),
        verdict(kernel.name, "hessian is symmetric", deviation(claimed, np.swapaxes(claimed, 1, 2)), 1e-14),
        verdict(
            kernel.name, "mixed = d gradient/dtheta", deviation(kernel.mixed(x, theta).reshape(mixed.shape), mixed)
        ),
    )


def check_effect(example: EffectExample, seed: int = 0) -> tuple[Check, ...]:
    """Every capability of an effect, in 2-D and 3-D, against differences of its force."""
    return tuple(check for dimension in (2, 3) for check in _effect_checks(example, dimension, seed))


def curvature_deviation(
    system: System, t: float, place: tuple[Array, Array], w: Array, rng: np.random.Generator
) -> float:
    """`System.curvature` along a random change of q, v and theta, against differences of `System.vjp`."""
    sizes = [system.n, system.n, system.parameter_count]
    cuts = np.cumsum(sizes)[:-1]
    direction = rng.normal(size=sum(sizes))

    def product(z: Array) -> Array:
        q, v, theta = np.split(z, cuts)
        theta_bar = np.zeros(len(theta))
        return np.concatenate([*system.with_theta(theta).vjp(t, q, v, w, theta_bar), theta_bar])

    measured = directional(product, np.concatenate([*place, system.theta]), direction[:, None])[:, 0]
    theta_bar = np.zeros(system.parameter_count)
    dq, dv, dtheta = np.split(direction, cuts)
    by_q, by_v = system.curvature(t, place, w, (dq, dv, dtheta), theta_bar)
    return deviation(np.concatenate([by_q, by_v, theta_bar]), measured)


def _effect_checks(example: EffectExample, dimension: int, seed: int) -> Iterator[Check]:
    rng = np.random.default_rng(seed)
    points = 5
    system = System(rng.uniform(0.5, 2.0, points), (example.make(rng, points, dimension),), dimension)
    q, v, w = rng.normal(size=(3, system.n))
    t, subject = 0.03, f"{example.name} {dimension}-D"
    effect: Any = system.effects[0]
    measured = {
        "dq": jacobian(lambda z: effect.force(t, z, v), q),
        "dv": jacobian(lambda z: effect.force(t, q, z), v),
        "dtheta": jacobian(lambda p: system.with_theta(p).force(t, q, v), system.theta),
    }
    for name, total in (("dq", system.dq), ("dv", system.dv), ("dtheta", system.dtheta)):
        yield verdict(subject, f"{name} of the force", deviation(total(t, q, v), measured[name]))
    if getattr(effect, "energy", None) is not None:
        slope = jacobian(lambda z: np.array([effect.energy(t, z)]), q)[0]
        yield verdict(subject, "force = -d energy/dq", deviation(-effect.force(t, q, v), slope))
    theta_bar = np.zeros(system.parameter_count)
    by_q, by_v = system.vjp(t, q, v, w, theta_bar)
    product = np.concatenate([by_q, by_v, theta_bar])
    expected = np.concatenate([measured[name].T @ w for name in ("dq", "dv", "dtheta")])
    yield verdict(subject, "vjp = transposed Jacobians", deviation(product, expected))
    limit = TWICE_DIFFERENCED if getattr(effect, "differenced", False) else EXACT
    yield verdict(subject, "curvature = d vjp", curvature_deviation(system, t, (q, v), w, rng), limit)
    if getattr(effect, "symmetric", False):
        skew = max(deviation(measured[name], measured[name].T) for name in ("dq", "dv"))
        yield verdict(subject, "Jacobians are symmetric", skew)
