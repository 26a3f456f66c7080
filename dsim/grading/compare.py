"""Comparisons for checks: shape, kind and finiteness first, then numbers; what is lost says by how much."""

from __future__ import annotations

from typing import Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.grading.curves import Entries, Lines, Picture
from dsim.grading.student import ItemLost


def array(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """The value as finite floats of this shape, or ItemLost in words for a student."""
    if not isinstance(value, np.ndarray | float | int) or isinstance(value, bool):
        raise ItemLost(f"{name} must be an array of shape {shape}; got {described(value)}")
    found = np.asarray(value)
    if found.dtype.kind not in "fiu":
        raise ItemLost(f"{name} must hold real numbers; got {found.dtype}")
    if found.shape != shape:
        raise ItemLost(f"{name} must have shape {shape}; got {found.shape}")
    found = found.astype(float)
    if not np.isfinite(found).all():
        raise ItemLost(f"{name} must be finite; {int((~np.isfinite(found)).sum())} of {found.size} entries are not")
    return found


def described(value: Any) -> str:
    """What came back, in words.

    >>> described(None), described((1.0, np.ones(3)))
    ('nothing (None): is there a return?', 'a tuple of 2')
    """
    if value is None:
        return "nothing (None): is there a return?"
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    return f"a {type(value).__name__}" + (f" of {len(value)}" if isinstance(value, tuple | list) else "")


def pair(name: str, value: Any, of: str) -> tuple[Any, Any]:
    """The two parts of a value, or ItemLost.  of: what they are, "(x, v)"."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise ItemLost(f"{name} must return the pair {of}; got {described(value)}")
    return value[0], value[1]


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
        picture = Entries(name, expected, found, tolerance * scale) if expected.size > 1 else None
        allowed = f"allowed is {tolerance:.0e}" if tolerance else "it must be exactly what it should be"
        beside = f" of the largest entry, {scale:.3g}" if scale > 1 else ""
        words = f"{name} is off by {error:.1e}{beside}; {allowed}{_likeness(found, expected, tolerance * scale)}"
        raise ItemLost(words, error, tolerance, picture)
    return found


def _likeness(found: Array, expected: Array, allowed: float) -> str:
    """What a wrong answer is instead, where that is easily said: a multiple, or the transpose."""
    with np.errstate(all="ignore"):  # numbers may be of any size
        square = float((expected**2).sum())
        if expected.size < 2 or not 0 < square < np.inf:
            return ""
        factor = float((found * expected).sum()) / square
        rest = float(np.abs(found - factor * expected).max())
    if 1e-3 < min(abs(factor), abs(factor - 1)) < np.inf and rest <= allowed * max(1.0, abs(factor)):
        return f". Yours is {factor:.4g} times what is expected"
    if expected.ndim == 2 and expected.shape[0] == expected.shape[1] and np.abs(found.T - expected).max() <= allowed:
        return ". Yours is the transpose of what is expected"
    return ""


def at_most(name: str, error: float, tolerance: float, picture: Picture | None = None) -> None:
    """error <= tolerance; NaN is not."""
    if not error <= tolerance:
        raise ItemLost(f"{name} is {error:.1e}; allowed is {tolerance:.0e}", float(error), tolerance, picture)


def order(h: Any, errors: Any, expected: int, low: float, high: float) -> float:
    """The observed order of accuracy, log(e1/e2) / log(h1/h2) of the last two errors, if it lies in low to high."""
    h, errors = np.asarray(h, float), np.clip(np.nan_to_num(errors, nan=1e15), 1e-15, 1e15)
    found = float(np.log(errors[-2] / errors[-1]) / np.log(h[-2] / h[-1]))
    if not low <= found <= high:
        slope = errors[-1] * (h / h[-1]) ** expected
        drawn = (("your error", h, errors), (f"order {expected}", h, slope))
        picture = Lines(f"observed order {found:.1f}", "step size h (s)", "error", drawn, log="xy")
        words = f"the observed order is {found:.1f}; it must be about {expected}"
        raise ItemLost(words, abs(found - expected), max(high - expected, expected - low), picture)
    return found
