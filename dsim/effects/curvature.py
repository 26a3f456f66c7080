"""Second derivatives of forces, as what a Hessian-vector product needs: the change of the vjp in one direction."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.arrays.differences import FIRST, line_length, slope
from dsim.arrays.frozen import replace
from dsim.effects.effect import current
from dsim.effects.rows import products

Change = tuple[Array, Array, Array]  # (dq (n,), dv (n,), dtheta in the effect's own flat order)


def curvature_of(effect: Any, t: float, place: tuple[Array, Array], w: Array, change: Change) -> tuple[Any, Any, Any]:
    """(d(dq^T) w, d(dv^T) w, d(dtheta^T) w) along a change, w fixed: by the effect's `curvature`, else by central
    differences of its products, to about ten digits; 0 for an effect without derivatives."""
    if states_curvature(effect):
        found: tuple[Any, Any, Any] = effect.curvature(t, *place, w, change)
        return found
    if all(getattr(effect, capability, None) is None for capability in ("vjp", "dq", "dv", "dtheta")):
        return 0.0, 0.0, 0.0
    return _differenced(effect, t, place, w, change)


def states_curvature(effect: Any) -> bool:
    """Whether the effect has a `curvature` written for its own force and derivatives."""
    return getattr(effect, "curvature", None) is not None and current(
        effect, "curvature", ("force", "dq", "dv", "dtheta", "vjp")
    )


def is_differenced(effect: Any) -> bool:
    """Whether second derivatives of the effect come from finite differences."""
    return not states_curvature(effect) or bool(getattr(effect, "curvature_differenced", False))


def _differenced(effect: Any, t: float, place: tuple[Array, Array], w: Array, change: Change) -> tuple[Any, Any, Any]:
    (q, v), (dq, dv, dtheta) = place, change
    if getattr(effect, "dtheta", None) is None:  # the parameters do not count as differentiable
        dtheta = np.zeros_like(dtheta)
    length = line_length((q, dq), (v, dv), (_parameters(effect)[getattr(effect, "columns", slice(None))], dtheta))
    if length == 0.0:
        return 0.0, 0.0, 0.0

    def along(s: float) -> Array:
        parts = products(_moved(effect, s * dtheta), t, (q + s * dq, v + s * dv), w)
        return np.concatenate([np.broadcast_to(p, d.shape) for p, d in zip(parts, change, strict=True)])

    by_q, by_v, by_theta = np.split(slope(along, FIRST / length), [len(q), 2 * len(q)])
    return by_q, by_v, by_theta


def _parameters(effect: Any) -> Array:
    """The effect's own parameters, flat."""
    values = [np.ravel(getattr(effect, label)) for label in getattr(effect, "parameters", ())]
    return np.concatenate([np.empty(0), *values])


def _moved(effect: Any, change: Array) -> Any:
    """The effect with changed parameters (those of its window, where it has one)."""
    if not change.any():
        return effect
    flat = _parameters(effect)
    flat[getattr(effect, "columns", slice(None))] += change
    values = {}
    for label in effect.parameters:
        shape = np.shape(getattr(effect, label))
        own, flat = np.split(flat, [int(np.prod(shape))])
        values[label] = own.reshape(shape)
    return replace(effect, **values)
