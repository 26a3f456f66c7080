"""Copies of frozen dataclasses that keep what was precomputed."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

T = TypeVar("T")


def replace(instance: T, **values: Any) -> T:
    """A shallow copy with some attributes exchanged and *no* validation run again.

    `dataclasses.replace` would validate and rebuild patterns; a finite difference at stiffness 0 must be
    able to step to -1e-8, and a bound effect must keep its sparsity patterns.
    """
    twin = copy.copy(instance)
    for name, value in values.items():
        object.__setattr__(twin, name, value)
    return twin
