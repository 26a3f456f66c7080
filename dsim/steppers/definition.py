"""A, B and C of a step by their definition: R = y1 - rule(y0, y1), differentiated block by block.

Nothing is eliminated and nothing is clever here; the fast path in `rule` is held against it by the tests.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array
from dsim.arrays.scatter import diagonal
from dsim.steppers.tableau import Coefficients, Symbol, Tableau, combine

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Slopes = dict[Symbol, Any]  # derivatives by state blocks and by theta, CSR
_THETA: Symbol = ("theta", 0, 0)


def jacobians(
    ode: Any, t: float, tableau: Tableau, states: dict[int, Array], start: bool
) -> tuple[csr_array, csr_array, csr_array]:
    """(A, B, C) of the residual in the whole state, history included; `start` for the step that makes a past."""
    from scipy.sparse import block_array, csr_array, eye_array

    slopes = _stage_slopes(ode, t, tableau, states)
    rows = [_chain(part, slopes) for part in tableau.outcome]

    def columns(symbols: list[Symbol], widths: list[int]) -> csr_array:
        empty = [csr_array((ode.n, width)) for width in widths]
        grid = [[row.get(s, zero) for s, zero in zip(symbols, empty, strict=True)] for row in rows]
        return csr_array(block_array(grid))

    def by_state(offset: int) -> csr_array:
        return columns([("y", offset, c) for c in range(ode.components)], [ode.n] * ode.components)

    one, zero = eye_array(ode.size, format="csr"), csr_array((ode.size, ode.size))
    A, B = csr_array(one - by_state(1)), -by_state(0)
    C, none = -columns([_THETA], [ode.parameter_count]), csr_array((ode.size, ode.parameter_count))
    if start:  # y1 = (y0, past)
        return _stack([[one, zero], [zero, A]]), _stack([[-one], [B]]), _stack([[none], [C]])
    if -1 in states:  # y0 = (y_n, y_{n-1}), y1 = (y_{n+1}, y_n)
        return _stack([[A, zero], [zero, one]]), _stack([[B, -by_state(-1)], [-one, zero]]), _stack([[C], [none]])
    return A, B, C


def _stage_slopes(ode: Any, t: float, tableau: Tableau, states: dict[int, Array]) -> dict[Symbol, Slopes]:
    """The derivative of every state block (a mask: pinned velocities count as 0) and of every rate."""
    masks = ode.blocks(np.ones(ode.size))
    symbols = [("y", offset, c) for offset in states for c in range(ode.components)]
    slopes: dict[Symbol, Slopes] = {s: {s: diagonal(masks[s[2]])} for s in symbols}
    values = {("y", n, c): block for n, y in states.items() for c, block in enumerate(ode.blocks(y))}
    scale = diagonal(ode.stage_solve(np.ones(ode.n)))  # M^-1
    for number, stage in enumerate(tableau.stages):
        time, place = t + stage.offset, tuple(np.zeros(ode.n) + combine(part, values) for part in stage.arguments)
        k = ode.rate(time, *place)
        total: Slopes = {_THETA: scale @ ode.stage_dtheta(time, place, k)}
        for partial, part in zip(ode.stage_partials(time, *place), stage.arguments, strict=True):
            for target, slope in _chain(part, slopes).items():
                total[target] = total.get(target, 0) + scale @ partial @ slope
        values["k", number, 0], slopes["k", number, 0] = k, total
    return slopes


def _chain(part: Coefficients, slopes: dict[Symbol, Slopes]) -> Slopes:
    """The derivative of an affine form."""
    total: Slopes = {}
    for symbol, coefficient in part.items():
        for target, slope in slopes[symbol].items():
            total[target] = total.get(target, 0) + coefficient * slope
    return total


def _stack(grid: list[list[Any]]) -> csr_array:
    from scipy.sparse import block_array, csr_array

    return csr_array(block_array(grid))


def curved_jacobians(
    ode: Any, t: float, tableau: Tableau, y0: Array, y1: Array
) -> tuple[csr_array, csr_array, csr_array]:
    """(A, B, C) of the same residual where positions do not add: column by column, through the coordinates of the
    step (`charts`)."""
    from scipy.sparse import csr_array

    values = {("y", n, c): block for n, y in ((0, y0), (1, y1)) for c, block in enumerate(ode.blocks(y))}
    places: list[Any] = []
    for number, stage in enumerate(tableau.stages):
        place = tuple(np.zeros(ode.n) + combine(part, values) for part in stage.arguments)
        places.append(place)
        values["k", number, 0] = ode.rate(t + stage.offset, *place)
    outcome = [np.zeros(ode.n) + combine(part, values) for part in tableau.outcome]

    def told(dy1: Array, dy0: Array, dtheta: Array) -> Array:
        start, blocks = ode.enter_tangent(dy0)
        changes = {("y", 0, c): block for c, block in enumerate(blocks)}
        changes |= {("y", 1, c): block for c, block in enumerate(ode.coordinates_tangent(y1, dy1, start))}
        for number, (stage, place) in enumerate(zip(tableau.stages, places, strict=True)):
            dplace = ode.carry(place, tuple(np.zeros(ode.n) + combine(p, changes) for p in stage.arguments), start)
            load = ode.stage_tangent(t + stage.offset, place, values["k", number, 0], dplace, dtheta)
            changes["k", number, 0] = ode.stage_solve(load)
        dparts = [np.zeros(ode.n) + combine(part, changes) for part in tableau.outcome]
        moved: Array = ode.leave_tangent(outcome, dparts, start)
        return moved

    none = np.zeros(ode.size), np.zeros(ode.size), np.zeros(ode.parameter_count)

    def columns(which: int) -> Array:
        units = np.eye(len(none[which]))
        found = [told(*(unit if i == which else zero for i, zero in enumerate(none))) for unit in units]
        return np.array(found).reshape(len(units), ode.size).T

    return csr_array(np.eye(ode.size) - columns(0)), csr_array(-columns(1)), csr_array(-columns(2))
