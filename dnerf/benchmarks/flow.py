"""Flows: error of every solver against evaluations and time, and what every variant costs in a training step."""

from typing import Any

from dnerf.benchmarks.flow_rows import CLOSED_FLOWS, solver_rows, variant_rows
from dnerf.benchmarks.suite import Plot, Series, Settings, SuiteResult, Table

AXES = {
    "evaluations": "evaluations of the velocity field",
    "milliseconds": "milliseconds for all points",
}


def run(settings: Settings) -> SuiteResult:
    """Carry points with every solver and setting along fields whose flow is known; time every variant."""
    few = settings.quick
    fields = (*list(CLOSED_FLOWS)[: 1 if few else None], "network")
    sizes: dict[str, Any] = {"num_points": 512 if few else 4096, "repeats": 1 if few else 3}
    if few:
        sizes |= {"steps": (1, 4), "tolerances": (1e-2, 1e-4)}
    solvers = solver_rows(fields, device=settings.device, **sizes)
    costs = variant_rows(num_samples=2048 if few else 24576, repeats=2 if few else 10, device=settings.device)
    return SuiteResult(
        title="Neural-ODE flow: error against evaluations and milliseconds",
        summary="Points in [-1, 1]^3 at random times are carried to time 0 in float64 along velocity fields whose flow "
        "has a closed form, and along a smooth network (truth: RK4 with 256 steps). Errors are distances in world "
        "units.",
        tables=[
            Table("Solvers", solvers),
            Table(
                "Variants",
                costs,
                "Samples of one training step, networks in bfloat16 where the machine has it; ratio to the first row.",
            ),
        ],
        plots=[_plot(solvers, field, axis) for field in fields for axis in AXES],
        findings=[_cheapest(solvers, field) for field in fields],
    )


def _cheapest(rows: list[dict[str, Any]], field: str, error: float = 1e-3) -> str:
    """Which setting reaches an error with the fewest evaluations."""
    good = [row for row in rows if row["field"] == field and row["max_error"] <= error]
    if not good:
        return f"{field}: no setting errs by less than {error:g}."
    best = min(good, key=lambda row: row["evaluations"])
    return (
        f"{field}: {best['solver']} with {best['setting']} errs by {best['max_error']:.1e} at most, with "
        f"{best['evaluations']} evaluations, the fewest for less than {error:g}."
    )


def _plot(rows: list[dict[str, Any]], field: str, axis: str) -> Plot:
    own = [row for row in rows if row["field"] == field]
    return Plot(
        name=f"{field}_{axis}",
        title=f"{field}: error of the solvers",
        x_label=AXES[axis],
        y_label="largest error, world units",
        series=[
            Series(
                solver,
                [row[axis] for row in own if row["solver"] == solver],
                # Rounding, which a logarithmic axis could not show as zero.
                [max(row["max_error"], 1e-16) for row in own if row["solver"] == solver],
            )
            for solver in dict.fromkeys(row["solver"] for row in own)
        ],
    )
