"""Input checks.  Every message names the argument, what came, and what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = Any  # what a user may write where an Array is stored: a number, a sequence, an array


def as_array(name: str, value: Any, shape: Sequence[int | None] | None = None) -> Array:
    """A read-only float64 copy of `value`; `None` in `shape` leaves that axis free.

    Raises ValueError naming the argument when the value is not numeric, not finite or of another shape.
    """
    kind = "a number" if shape is not None and len(shape) == 0 else "numbers"
    try:
        if value is None:  # which NumPy would take for NaN
            raise TypeError("None is no number")
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be {kind}; got {value!r:.60}") from error
    if shape is not None and not _fits(array.shape, shape):
        wanted = f"have shape {_shape_text(shape)}" if len(shape) else "be a number"
        raise ValueError(f"{name} must {wanted}; got {'shape ' if not len(shape) else ''}{array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; got {_first(array, ~np.isfinite(array))}")
    array.setflags(write=False)
    return array


def as_nonnegative(name: str, value: Any, shape: Sequence[int | None] | None = None) -> Array:
    """`as_array`, and every entry >= 0."""
    array = as_array(name, value, shape)
    if (array < 0).any():
        raise ValueError(f"{name} must be >= 0; got {_first(array, array < 0)}")
    return array


def as_positive(name: str, value: Any, shape: Sequence[int | None] | None = None) -> Array:
    """`as_array`, and every entry > 0."""
    array = as_array(name, value, shape)
    if (array <= 0).any():
        raise ValueError(f"{name} must be > 0; got {_first(array, array <= 0)}")
    return array


def as_answer(name: str, value: Any, *shapes: tuple[int, ...]) -> Array:
    """What a user's function returned: numbers of one of `shapes`.  NaN may pass: a run ends there by itself."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must return numbers; got {value!r:.60}") from error
    if array.shape not in shapes:
        raise ValueError(f"{name} must return shape {shapes[0]}; got {array.shape}")
    return array


def as_step(h: Any) -> float:
    """A step size: finite and > 0."""
    return float(as_positive("h", h, ()))


def as_count(name: str, value: Any, least: int = 0) -> int:
    """A whole number >= `least`."""
    try:
        count = int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be a whole number >= {least}; got {value!r:.60}") from error
    if np.ndim(value) or count != value or count < least:
        raise ValueError(f"{name} must be a whole number >= {least}; got {value!r:.60}")
    return count


def as_pairs(name: str, value: Any) -> NDArray[np.int64]:
    """(E,2) point indices, each >= 0 and no pair joining a point to itself."""
    try:
        pairs = np.array(value)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} must be whole numbers of shape (E, 2); got {value!r:.60}") from error
    if pairs.size == 0:
        pairs = np.empty((0, 2), dtype=np.int64)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.integer):
        raise ValueError(f"{name} must be whole numbers of shape (E, 2); got {pairs.dtype} {pairs.shape}")
    loops = pairs[:, 0] == pairs[:, 1]
    if loops.any():
        row = int(np.flatnonzero(loops)[0])
        raise ValueError(f"{name} must join two different points; got {tuple(pairs[row].tolist())} at row {row}")
    if (pairs < 0).any():
        row = int(np.flatnonzero((pairs < 0).any(axis=1))[0])
        raise ValueError(f"{name} must be indices >= 0; got {tuple(pairs[row].tolist())} at row {row}")
    pairs = np.minimum(pairs, np.iinfo(np.int64).max).astype(np.int64)  # no unsigned index wraps round
    pairs.setflags(write=False)
    return pairs


def check_indices(name: str, indices: NDArray[np.int64], count: int) -> None:
    """Every index below `count`."""
    if indices.size and int(indices.max()) >= count:
        raise ValueError(f"{name} must be indices below {count}, the number of points; got {int(indices.max())}")


def _fits(shape: tuple[int, ...], expected: Sequence[int | None]) -> bool:
    return len(shape) == len(expected) and all(e is None or s == e for s, e in zip(shape, expected, strict=True))


def _shape_text(shape: Sequence[int | None]) -> str:
    return "(" + ", ".join("any" if s is None else str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"


def _first(array: Array, bad: NDArray[np.bool_]) -> str:
    if array.ndim == 0:
        return str(array)
    where = tuple(int(i) for i in np.argwhere(bad)[0])
    return f"{array[where]} at index {where[0] if len(where) == 1 else where}"
