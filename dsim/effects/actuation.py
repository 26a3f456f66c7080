"""Actuation: one given force vector a step, p = [f_0^act, ..., f_n^act].  Lecture: "What about dynamics?"."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_array, as_step
from dsim.arrays.frozen import replace
from dsim.effects.curvature import Change

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# A time t_n = n h carries round-off of a few eps n; a millionth of a step decides between rows safely.
_SLACK = 1e-6


@dataclass(frozen=True, eq=False)
class Actuation:
    """f(t) = forces[n] during step n, n h <= t < (n+1) h.  forces (steps,N,d) N, h s.

    Within a step every evaluation uses the row of the step, whatever stage time the stepper asks for.
    Raises ValueError when stepped with another h, or outside its rows.
    """

    forces: Numbers
    h: float
    name: str = "actuation"
    parameters = ("forces",)
    symmetric = True
    row: int | None = None  # set by at: the step's row

    def __post_init__(self) -> None:
        forces = as_array("forces", self.forces)
        if forces.ndim != 3:
            raise ValueError(f"forces must have shape (steps, points, dimension); got {forces.shape}")
        object.__setattr__(self, "forces", forces)
        object.__setattr__(self, "h", as_step(self.h))

    def bind(self, mass: Array, dimension: int) -> Actuation:
        as_array("forces", self.forces, (None, len(mass), dimension))
        return self

    def at(self, t: float, q: Array, h: float) -> Actuation:
        if abs(h - self.h) > 1e-9 * self.h:
            raise ValueError(f"h must be {self.h}, the step {self.name} was made for; got {h}")
        return replace(self, row=self._row(t, end_counts=False))

    @property
    def columns(self) -> slice:
        """The flat parameters that this step touches: its own row, or all of them outside a step."""
        width = self.forces[0].size
        return slice(None) if self.row is None else slice(self.row * width, (self.row + 1) * width)

    def _row(self, t: float, end_counts: bool = True) -> int:
        if self.row is not None:
            return self.row
        row, rows = int(np.floor(t / self.h + _SLACK)), len(self.forces)
        if end_counts and row == rows and abs(t / self.h - rows) <= _SLACK:
            row = rows - 1  # the closing instant belongs to the last step
        if not 0 <= row < rows:
            raise ValueError(f"{self.name} has {rows} rows of h = {self.h}; got t = {t:.6g}, which asks for row {row}")
        return row

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self.forces[self._row(t)].ravel()

    def energy(self, t: float, q: Array) -> float:
        return -float(self.force(t, q, q) @ q)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        n = self.forces[0].size
        first = 0 if self.row is not None else self._row(t) * n
        width = n if self.row is not None else self.forces.size
        return csr_array((np.ones(n), (np.arange(n), first + np.arange(n))), shape=(n, width))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[float, float, Array]:
        if self.row is not None:
            return 0.0, 0.0, w
        bar = np.zeros(self.forces.size)
        row, n = self._row(t), len(w)
        bar[row * n : (row + 1) * n] = w
        return 0.0, 0.0, bar

    def curvature(self, t: float, q: Array, v: Array, w: Array, change: Change) -> tuple[float, float, float]:
        """0: the force is its parameters."""
        return 0.0, 0.0, 0.0
