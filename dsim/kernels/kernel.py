"""What an element energy provides."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dsim.arrays.checks import Array


class Kernel(NamedTuple):
    """Energy W of E elements at once, and its derivatives.  Checked against each other by the catalog.

    x (E,k,d) are the points of every element, theta (E,p) its parameters, columns as in `parameters`.
    """

    name: str
    parameters: tuple[str, ...]
    energy: Callable[[Array, Array], Array]  # W -> (E,)
    gradient: Callable[[Array, Array], Array]  # dW/dx -> (E,k,d)
    hessian: Callable[[Array, Array], Array]  # d2W/dx2 -> (E,k,d,k,d), exact, never projected
    mixed: Callable[[Array, Array], Array]  # d2W/dx dtheta -> (E,k,d,p)
    sample: Callable[[np.random.Generator], tuple[Array, Array]]  # a generic (x, theta)
