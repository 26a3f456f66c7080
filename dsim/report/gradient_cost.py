"""What gradients cost and how they converge: `dsim accuracy gradients`, and parts of the report's section."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dsim.pictures import gradients as pictures
from dsim.pictures.style import save
from dsim.report.model import Cell, Table
from dsim.studies import gradient_cost as cost
from dsim.studies import gradient_order as order
from dsim.studies.cells import Store
from dsim.studies.check import Check
from dsim.studies.work_precision import Study, work_precision

PICTURES = "gradient-cost", "gradient-orders"


@dataclass(frozen=True)
class Results:
    """The cost over the number of parameters, and the orders on a smooth problem, at a kink and at a jump."""

    cost: cost.CostStudy
    orders: dict[str, Study]

    @property
    def checks(self) -> list[Check]:
        return [*cost.cost_checks(self.cost), *order.order_checks(*self.orders.values())]

    def tables(self) -> tuple[Table, ...]:
        rows = tuple(("pass" if c.passed else "FAIL", c.subject, c.statement, c.measured, c.bound) for c in self.checks)
        return (*cost_tables(self.cost), order_table(self.orders),
                Table(("", "subject", "statement", "measured", "bound"), rows, "Checks"))  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        orders = [study.to_dict() for study in self.orders.values()]
        return {"cost": self.cost.to_dict(), "orders": orders, "checks": [asdict(check) for check in self.checks]}


def measure(quick: bool, store: Store, progress: Callable[[str], None]) -> Results:
    """Both studies, from what the store has and what is missing."""
    net, sweep = (cost.Net(points=24), cost.QUICK) if quick else (cost.Net(), cost.Sweep())
    return Results(cost.gradient_cost(net, sweep, store, progress), orders(quick, store, progress))


def orders(quick: bool, store: Store, progress: Callable[[str], None]) -> dict[str, Study]:
    """State and gradient over h where the force is smooth, has a kink, has a jump."""
    sweep = order.SHORT if quick else order.SWEEP
    smooth = work_precision(order.marble_in_a_bowl(), order.METHODS, sweep, store, progress)
    kink = work_precision(order.slack_band(), order.EXPLICIT if quick else order.METHODS, sweep, store, progress)
    jump = work_precision(order.edge_of_a_fan(), order.EXPLICIT, sweep, store, progress)
    return {"smooth: marble in a bowl": smooth, "kink: slack band": kink, "jump: edge of a fan": jump}


def draw(results: Results, to: Path) -> None:
    """Both pictures, each as PNG and SVG."""
    costs, orders = PICTURES
    for kind in ("png", "svg"):
        save(pictures.gradient_cost(results.cost), to / f"{costs}.{kind}")
        save(pictures.gradient_orders(results.orders), to / f"{orders}.{kind}")


def cost_tables(study: cost.CostStudy) -> tuple[Table, Table]:
    """Costs, extrapolated ones marked, and errors: a row a number of parameters."""
    columns = ("parameters", *study.methods)
    counts = sorted({cell.parameters for cell in study.cells})
    costs: list[tuple[Cell, ...]] = []
    errors: list[tuple[Cell, ...]] = []
    cells = {(cell.method, cell.parameters): cell.error for cell in study.cells}
    for k in counts:
        costs.append((k, *(_words(*study.cost(method, k)) for method in study.methods)))
        errors.append((k, *(f"{cells[method, k]:.0e}" for method in study.methods)))
    band = (
        f"; a run timed against itself: {study.band[0]:.2f} to {study.band[1]:.2f}" if study.unit == "seconds" else ""
    )
    unit = "Seconds" if study.unit == "seconds" else "Passes"
    where = f"{study.springs} springs, {study.steps} steps"
    return (
        Table(columns, tuple(costs), f"{unit} of a gradient on {where} (~: extrapolated, not run){band}"),
        Table(columns, tuple(errors), "Error of the gradient, relative to its largest sampled entry"),
    )


def _words(cost: float, measured: bool) -> str:
    return "" if cost != cost else f"{'' if measured else '~'}{cost:.2g}"


def order_table(studies: dict[str, Study]) -> Table:
    """A row a problem and a method."""
    rows: list[tuple[Cell, ...]] = []
    for title, study in studies.items():
        for method, of_state, of_gradient, state, gradient in order.order_rows(study):
            rows.append((title, method, of_state, of_gradient, f"{state:.0e}", f"{gradient:.0e}"))
    caption = "Orders of state and gradient; errors at the finest h"
    return Table(("problem", "method", "order", "of gradient", "state", "gradient"), tuple(rows), caption)
