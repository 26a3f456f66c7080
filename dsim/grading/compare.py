"""Comparisons for checks: shape, kind and finiteness first, then numbers; what is lost says by how much."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.grading.student import ItemLost


def array(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """The value as finite floats of this shape, or ItemLost in words for a student."""
    if not isinstance(value, np.ndarray | float | int) or isinstance(value, bool):
        kind = "nothing (None)" if value is None else f"a {type(value).__name__}"
        raise ItemLost(f"{name} must be an array of shape {shape}; got {kind}")
    found = np.asarray(value)
    if found.dtype.kind not in "fiu":
        raise ItemLost(f"{name} must hold real numbers; got {found.dtype}")
    if found.shape != shape:
        raise ItemLost(f"{name} must have shape {shape}; got {found.shape}")
    found = found.astype(float)
    if not np.isfinite(found).all():
        raise ItemLost(f"{name} must be finite; {int((~np.isfinite(found)).sum())} of {found.size} entries are not")
    return found


def number(name: str, value: Any) -> float:
    """The value as one finite float."""
    return float(array(name, value.reshape(()) if isinstance(value, np.ndarray) and value.size == 1 else value, ()))


def close(name: str, value: Any, expected: Any, tolerance: float) -> Array:
    """The value, within tolerance of what is expected, relative to its largest entry (or 1, if that is smaller)."""
    expected = np.asarray(expected, dtype=float)
    found = array(name, value, expected.shape)
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    error = float(np.abs(found - expected).max(initial=0.0)) / scale
    if not error <= tolerance:
        raise ItemLost(f"{name} is off by {error:.1e}, relative; allowed is {tolerance:.0e}", error, tolerance)
    return found


def at_most(name: str, error: float, tolerance: float) -> None:
    """error <= tolerance; NaN is not."""
    if not error <= tolerance:
        raise ItemLost(f"{name} is {error:.1e}; allowed is {tolerance:.0e}", float(error), tolerance)
