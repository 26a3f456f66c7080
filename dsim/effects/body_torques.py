"""Torques on bodies: given ones, a row a step, and drag on rotation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dsim.arrays.checks import Array, Numbers, as_array, as_nonnegative
from dsim.arrays.frozen import replace
from dsim.arrays.rotation import conjugate, cross, rotate, skew, to_matrix
from dsim.effects.actuation import Actuation
from dsim.effects.bodies import BodyLayout

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class AngularDrag:
    """tau = -c omega.  coefficient: a number or (B,) N m s >= 0."""

    coefficient: Numbers
    name: str = "angular_drag"
    parameters = ("coefficient",)
    layout: BodyLayout | None = None  # set by bind_bodies

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficient", as_nonnegative("coefficient", self.coefficient))

    def bind_bodies(self, layout: BodyLayout) -> AngularDrag:
        if self.coefficient.ndim:
            as_array("coefficient", self.coefficient, (layout.turning,))
        return replace(self, layout=layout)

    def _spins(self, v: Array) -> Array:
        assert self.layout is not None
        return self.layout.spins(v)

    def force(self, t: float, q: Array, v: Array) -> Array:
        out = np.zeros_like(v)
        self._spins(out)[:] = -(self.coefficient * self._spins(v).T).T
        return out

    def dv(self, t: float, q: Array, v: Array) -> Any:
        assert self.layout is not None
        places = self.layout.spin_dofs
        drags = np.broadcast_to(self.coefficient, len(places))
        return self.layout.by_turns(places, -drags[:, None, None] * np.eye(3))

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        assert self.layout is not None
        places, count = self.layout.spin_dofs, self.coefficient.size
        columns = np.repeat(np.arange(len(places)) if self.coefficient.ndim else np.zeros(len(places), int), 3)
        return csr_array((-self._spins(v).ravel(), (places.ravel(), columns)), shape=(self.layout.n, count))

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[float, Array, Array]:
        by_body = -(self._spins(v) * self._spins(w)).sum(axis=1)
        return 0.0, self.force(t, q, w), by_body if self.coefficient.ndim else np.atleast_1d(by_body.sum())


@dataclass(frozen=True, eq=False)
class TorqueActuation:
    """tau(t) = torques[n] during step n, as `Actuation`'s forces.  torques (steps,B,3) N m, h s.

    frame: "world", or "body" for motors that turn with it.
    """

    torques: Numbers
    h: float
    frame: Literal["world", "body"] = "world"
    name: str = "torque"
    parameters = ("torques",)
    layout: BodyLayout | None = None  # set by bind_bodies
    row: int | None = None  # set by at: the step's row

    def __post_init__(self) -> None:
        torques = as_array("torques", self.torques)
        if torques.ndim != 3 or torques.shape[2] != 3:
            raise ValueError(f"torques must have shape (steps, bodies, 3); got {torques.shape}")
        if self.frame not in ("world", "body"):
            raise ValueError(f'frame must be "world" or "body"; got {self.frame!r}')
        object.__setattr__(self, "torques", torques)
        object.__setattr__(self, "h", self._rows().h)

    def bind_bodies(self, layout: BodyLayout) -> TorqueActuation:
        as_array("torques", self.torques, (None, layout.turning, 3))
        return replace(self, layout=layout)

    def _rows(self) -> Any:
        """The same numbers as an actuation, which knows which row a time belongs to."""
        return replace(Actuation(self.torques, self.h, name=self.name), row=self.row)

    def at(self, t: float, q: Array, h: float) -> TorqueActuation:
        return replace(self, row=self._rows().at(t, q, h).row)

    @property
    def columns(self) -> slice:
        return self._rows().columns

    def _torque(self, t: float, q: Array) -> Array:
        """(B,3) in the body frame."""
        assert self.layout is not None
        given: Array = self._rows().force(t, q, q).reshape(-1, 3)
        return rotate(conjugate(self.layout.turns(q)), given) if self.frame == "world" else given

    def force(self, t: float, q: Array, v: Array) -> Array:
        assert self.layout is not None
        out = np.zeros(self.layout.n)
        self.layout.spins(out)[:] = self._torque(t, q)
        return out

    @property
    def dq(self) -> Any:
        """R^T tau changes with a turn of the body by (R^T tau) x delta; motors that turn with it do not notice."""
        return self._dq if self.frame == "world" else None

    def _dq(self, t: float, q: Array, v: Array) -> Any:
        assert self.layout is not None
        return self.layout.by_turns(self.layout.spin_dofs, skew(self._torque(t, q)))

    def dtheta(self, t: float, q: Array, v: Array) -> csr_array:
        from scipy.sparse import csr_array

        assert self.layout is not None
        places = self.layout.spin_dofs
        turned = to_matrix(conjugate(self.layout.turns(q)))
        blocks = turned if self.frame == "world" else np.broadcast_to(np.eye(3), turned.shape)
        local = csr_array(self._rows().dtheta(t, q, v))  # (3B, p): which parameters the torques are
        rows, columns = np.broadcast_to(places[:, :, None], blocks.shape), np.arange(3 * len(places)).reshape(-1, 1, 3)
        columns = np.broadcast_to(columns, blocks.shape)
        spread = csr_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(self.layout.n, local.shape[0]))
        return csr_array(spread @ local)

    def vjp(self, t: float, q: Array, v: Array, w: Array) -> tuple[Array | float, float, Array]:
        assert self.layout is not None
        b = self.layout.spins(w)
        given = rotate(self.layout.turns(q), b) if self.frame == "world" else b
        by_q: Array | float = 0.0
        if self.frame == "world":
            by_q = np.zeros(self.layout.n)
            self.layout.spins(by_q)[:] = cross(b, self._torque(t, q))
        return by_q, 0.0, self._rows().vjp(t, q, v, np.ascontiguousarray(given).ravel())[2]
