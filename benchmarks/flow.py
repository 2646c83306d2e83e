"""Flows: error of every solver against evaluations and time, and what every variant costs in a training step."""

import math
from typing import Any

from benchmarks.flow_rows import CLOSED_FLOWS, solver_rows, variant_rows
from benchmarks.suite import BarPlot, Plot, Row, Series, Settings, SuiteResult, Table
from benchmarks.timing import fitted_order
from dnerf.deformations.solvers import FIXED_SOLVERS

ROUNDED = 1e-14
"""Errors below this are float64's rounding."""
SMALL = 0.5
"""Errors above this, in world units, say nothing of an order of convergence."""
ORDERS_NOTE = f"Least squares over the last three errors between rounding and {SMALL:g}."
VARIANTS_NOTE = "Samples of one training step, networks in bfloat16 where the machine has it; ratio to the first row."
LOST = 2.0
"""Errors above this, in world units, are as large as the scene: a solver that explodes, which would spoil a plot."""
ENOUGH = 1e-3
"""Error in world units that no image shows: a tenth of a step of the fast renderer."""


def run(settings: Settings) -> SuiteResult:
    """Carry points with every solver and setting along fields whose flow is known; time every variant."""
    few = settings.quick
    fields = (*list(CLOSED_FLOWS)[: 1 if few else None], "network")
    sizes: dict[str, Any] = {"num_points": 256 if few else 1024, "repeats": 1 if few else 3}
    if few:
        sizes |= {"steps": (1, 4), "tolerances": (1e-2, 1e-4)}
    solvers = solver_rows(fields, device=settings.device, **sizes)
    costs = variant_rows(num_samples=2048 if few else 24576, repeats=2 if few else 7, device=settings.device)
    return SuiteResult(
        title="Neural-ODE flow: error against evaluations and milliseconds",
        summary=f"{sizes['num_points']:,} points in [-1, 1]^3 at random times are carried to time 0 in float64 along "
        "velocity fields whose flow has a closed form (a rotation by up to 2 radians, a shear to and fro, an expansion "
        "by up to exp(1.5), a swirl that is faster further out), and along a smooth network (truth: RK4 with 512 "
        "steps). Errors are distances in world units. Fixed-step solvers take 1 to 64 steps, adaptive ones (dopri5, "
        "dopri8, bosh3, adaptive_heun, of torchdiffeq) tolerances from 1e-2 to 1e-6. An expansion and a rotation do "
        "not depend on time. The network has thin features, which coarse steps miss: its orders show late.",
        tables=[
            Table("Orders of convergence", _orders(solvers), ORDERS_NOTE),
            Table("Variants", costs, VARIANTS_NOTE),
            Table("Solvers", solvers),
        ],
        plots=[*(_plot(solvers, field) for field in fields), _costs_plot(costs)],
        findings=[*(_cheapest(solvers, field) for field in fields), _slowest(costs)],
    )


def _order(rows: list[Row]) -> float | None:
    kept = [row for row in rows if ROUNDED < row["max_error"] < SMALL][-3:]
    if len(kept) < 2:
        return None
    return fitted_order([float(row["evaluations"]) for row in kept], [row["max_error"] for row in kept])


def _orders(rows: list[Row]) -> list[Row]:
    """Fitted order of every fixed-step solver on every field beside its theory."""
    return [
        {"field": field, **{f"{s} (theory {order})": _order(_of(rows, field, s)) for s, order in FIXED_SOLVERS.items()}}
        for field in dict.fromkeys(row["field"] for row in rows)
    ]


def _of(rows: list[Row], field: str, solver: str) -> list[Row]:
    return [row for row in rows if row["field"] == field and row["solver"] == solver]


def _cheapest(rows: list[Row], field: str) -> str:
    """Which setting reaches an error with the fewest evaluations."""
    good = [row for row in rows if row["field"] == field and row["max_error"] <= ENOUGH]
    if not good:
        return f"{field}: no setting errs by less than {ENOUGH:g}."
    best = min(good, key=lambda row: row["evaluations"])
    quickest = min(good, key=lambda row: row["median_ms"])
    return (
        f"{field}: the fewest evaluations for an error below {ENOUGH:g} are {best['evaluations']}, {best['solver']} "
        f"with {best['setting']} ({best['max_error']:.1e} at most); the quickest is {quickest['solver']} with "
        f"{quickest['setting']}, {quickest['median_ms']:.2g} ms."
    )


def _slowest(rows: list[Row]) -> str:
    flows = [row for row in rows if row["variant"].startswith("flow")]
    low, high = (choose(flows, key=lambda row: row["ratio"]) for choose in (min, max))
    return (
        f"In a training step the cheapest flow ({low['variant']}) takes {low['ratio']:.2g} times as long as the "
        f"displacement network, the dearest ({high['variant']}) {high['ratio']:.2g} times."
    )


def _plot(rows: list[Row], field: str) -> Plot:
    series = []
    for solver in dict.fromkeys(row["solver"] for row in rows):
        own = _of(rows, field, solver)
        order = _order(own) if solver in FIXED_SOLVERS else None
        series.append(
            Series(
                solver if order is None else f"{solver} (order {order:.1f})",
                [row["evaluations"] for row in own],
                # Rounding, which a logarithmic axis could not show as zero.
                [max(row["max_error"], 1e-16) if row["max_error"] < LOST else math.nan for row in own],
                style="line" if solver in FIXED_SOLVERS else "dashed",
            )
        )
    return Plot(
        name=field, title=f"{field}: error of the solvers against evaluations",
        x_label="evaluations of the velocity field", y_label="largest error (world units)", series=series,
        note="Down and left is better. Solid: fixed steps; dashed: adaptive, from tolerance 1e-2 on the left. "
        f"Errors above {LOST:g} world units, the scene's own size, are left out.",
    )  # fmt: skip


def _costs_plot(rows: list[Row]) -> BarPlot:
    return BarPlot(
        "variants", "What a deformation costs in a training step", "milliseconds", [row["variant"] for row in rows],
        {"forward": [r["forward_ms"] for r in rows], "forward + backward": [r["training_ms"] for r in rows]},
        note="The first row is the displacement network that needs no integration.",
        log=True,
    )  # fmt: skip
