"""Arrays of other libraries, through the array protocols; nothing is imported but NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim.arrays.checks import Array


def to_numpy(name: str, value: Any) -> Any:
    """A NumPy copy of any array: PyTorch's (also on a device, also requiring grad), JAX's, Python's numbers."""
    for method in ("detach", "cpu"):
        if hasattr(value, method) and callable(getattr(value, method)):
            value = getattr(value, method)()
    try:
        array = np.array(value)
        if array.dtype == object and hasattr(value, "__dlpack__"):
            array = np.array(np.from_dlpack(value))
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be an array of numbers; got {type(value).__name__} ({error})") from error
    if not np.issubdtype(array.dtype, np.number) and array.dtype != bool:
        raise ValueError(f"{name} must be an array of numbers; got {type(value).__name__} of {array.dtype}")
    if np.iscomplexobj(array):
        raise ValueError(f"{name} must be real; got {array.dtype}")
    return array


def like(original: Any) -> Callable[[Array], Any]:
    """A function that turns a NumPy array into the kind of array that `original` is."""
    if hasattr(original, "new_tensor"):  # PyTorch
        return lambda a: original.new_tensor(a)
    if isinstance(original, np.ndarray | np.generic | int | float | list | tuple):
        return lambda a: a.copy()
    if hasattr(original, "__array_namespace__"):  # JAX and the others of the array API
        namespace = original.__array_namespace__()
        return lambda a: namespace.asarray(a, dtype=original.dtype)
    return lambda a: a.copy()
