"""What moves a soft body: springs whose rest lengths are set step by step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_pairs, as_positive, as_step
from dsim.arrays.frozen import replace
from dsim.effects import Springs

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class Muscles:
    """Springs that push and pull: U = k/2 (|x_ij| - rest_length[n])^2 while n h <= t < (n+1) h.

    pairs (E,2); rest_length (steps,E) m: the actuation, one row a step; stiffness N/m, a number or (E,); h s.
    A muscle pulls its two ends together: alone it cannot move the body as a whole.
    Raises ValueError on bad input, and outside the rows' time.
    """

    pairs: Numbers
    rest_length: Numbers
    stiffness: Numbers
    h: float
    name: str = "muscles"
    parameters = ("rest_length",)
    symmetric = True
    springs: Springs | None = field(default=None, repr=False)  # set by bind

    def __post_init__(self) -> None:
        pairs = as_pairs("pairs", self.pairs)
        object.__setattr__(self, "pairs", pairs)
        object.__setattr__(self, "rest_length", as_positive("rest_length", self.rest_length, (None, len(pairs))))
        object.__setattr__(self, "h", as_step(self.h))

    def bind(self, mass: Array, dimension: int) -> Muscles:
        springs = Springs(self.pairs, self.rest_length[0], self.stiffness)
        return replace(self, springs=springs.bind(mass, dimension))

    def row(self, t: float) -> int:
        """The row of time t; the closing instant belongs to the last one."""
        row, rows = int(np.floor(t / self.h + 1e-6)), len(self.rest_length)
        if not 0 <= row <= rows:
            raise ValueError(f"{self.name} has {rows} rows of h = {self.h}; got t = {t:.6g}, which asks for row {row}")
        return min(row, rows - 1)

    def _now(self, t: float) -> Springs:
        """The springs of time t."""
        assert self.springs is not None
        return replace(self.springs, rest_length=self.rest_length[self.row(t)])

    def rows(self) -> MuscleRows:
        return MuscleRows(self)

    def force(self, t: float, q: Array, v: Array) -> Array:
        return self._now(t).force(t, q, v)

    def energy(self, t: float, q: Array) -> float:
        return self._now(t).energy(t, q)

    def dq(self, t: float, q: Array, v: Array) -> csr_array:
        return self._now(t).dq(t, q, v)

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        width = len(self.pairs)
        own = self._now(t).dtheta(t, q, v).tocsc()[:, :width].tocoo()
        return csr_array((own.data, (own.row, self.row(t) * width + own.col)), shape=(len(q), self.rest_length.size))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array, float, Array]:
        by_q, by_v, theta = self._now(t).vjp(t, q, v, w)
        bar = np.zeros(self.rest_length.shape)
        bar[self.row(t)] = theta[: len(self.pairs)]
        return by_q, by_v, bar.ravel()


class MuscleRows:
    """Muscles in place: the rows of the springs of the moment.  On the way back a step touches its own row alone, so
    that the cost of a gradient grows with the steps, not with their square."""

    def __init__(self, muscles: Muscles) -> None:
        springs = muscles.springs
        assert springs is not None
        self.muscles, self.springs = muscles, springs.rows()
        self.saves = self.springs.saves
        self.unused = np.zeros(len(muscles.pairs))  # the gradient by the stiffness, which is no parameter here

    def _turn_to(self, t: float) -> int:
        row = self.muscles.row(t)
        self.springs.rest = self.muscles.rest_length[row]
        self.springs.preload = self.springs.stiffness * self.springs.rest
        return row

    def add_force(self, t: float, x: Array, v: Array, out: Array, saved: tuple[Array, ...]) -> None:
        self._turn_to(t)
        self.springs.add_force(t, x, v, out, saved)

    def add_vjp(self, t: float, place: tuple[Array, Array], w: Array, bars: Any, saved: tuple[Array, ...]) -> None:
        x_bar, v_bar, rest_length = bars
        own = rest_length.reshape(self.muscles.rest_length.shape)[self._turn_to(t)]
        self.springs.add_vjp(t, place, w, (x_bar, v_bar, own, self.unused), saved)
