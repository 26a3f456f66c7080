"""The seam between a system and its forces."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from dsim.arrays.checks import Array


def current(effect: object, capability: str, stated: tuple[str, ...]) -> bool:
    """Whether a capability still describes the effect: no subclass of the class that has it restates one of `stated`.

    A subclass that overrides the force inherits rows, products or a symmetry that were written for another one.
    """
    for kind in type(effect).__mro__:
        if capability in vars(kind):
            return True
        if any(name in vars(kind) for name in stated):
            return False
    return True  # an attribute of the instance


@runtime_checkable
class Effect(Protocol):
    """A generalized force.  Only `name` and `force` are required.

    Optional capabilities; a missing one counts as structurally zero and is never evaluated:

    - `bind(mass, dimension) -> Effect`: sizes, broadcasts and patterns, once, when a System is made;
    - `energy(t, q) -> float`, J, with force = -d energy/dq;
    - `dq(t, q, v)`, `dv(t, q, v)` -> CSR (n,n): the force Jacobians, exact, N/m and N s/m;
    - `parameters: tuple[str, ...]`: attributes to differentiate by; "mass" is the system's own;
    - `dtheta(t, q, v)` -> CSR (n,p), columns in the order of `parameters`, each flattened;
    - `vjp(t, q, v, w) -> (dq^T w, dv^T w, dtheta^T w)`, without forming a matrix; 0 for a part that vanishes;
    - `curvature(t, q, v, w, change)` -> the derivative of the vjp along change = (dq, dv, dtheta) at fixed w, in the
      same order and layout, for second derivatives; without one they are central differences of the vjp;
    - `curvature_differenced: bool`: the curvature itself is a difference;
    - `rows() -> Rows`: the force and its vjp on coordinate rows, in place, for explicit runs;
    - `symmetric: bool`: dq and dv are symmetric (band Cholesky and CG may be used);
    - `at(t, q, h) -> Effect`: freezes discrete choices for one step; its `columns` names the parameters left.
    """

    @property
    def name(self) -> str: ...

    def force(self, t: float, q: Array, v: Array) -> Array:
        """(n,) generalized force, N.  q (n,) m, v (n,) m/s, t s."""
        ...
