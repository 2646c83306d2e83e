"""Float64, float32 and bfloat16 autocast: what each part loses, value and gradient, and what it saves."""

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from dnerf.benchmarks.flow_rows import smooth_network
from dnerf.benchmarks.suite import BarPlot, Settings, SuiteResult, Table
from dnerf.benchmarks.timing import Timing, time_in_turn
from dnerf.compositing import FieldOutput, composite
from dnerf.deformations import DisplacementDeformation, FlowDeformation
from dnerf.encodings import SinusoidalEncoding
from dnerf.fields import GridField, NeRFField
from dnerf.kernels import GridLevels, grid_encode, use_backend
from dnerf.rays import Samples

PRECISIONS = ("float64", "float32", "bfloat16 autocast")
Part = Callable[[torch.dtype], tuple[Callable[..., Tensor], list[Tensor]]]


def run(settings: Settings) -> SuiteResult:
    """Run every part in every precision on the same numbers."""
    count = 2000 if settings.quick else 20000
    rows = []
    for name, part in parts(count, settings.seed).items():
        rows += _rows(name, part, settings)
    return SuiteResult(
        title="Precision: float64, float32, bfloat16 autocast",
        summary=(
            f"Every part on the same {count:,} inputs, which float32 represents exactly. The error of the value is the "
            "root mean square difference to float64 relative to its root mean square, and likewise for the gradient of "
            "its sum to the first input (positions or densities). Under autocast the package keeps positions, "
            "encodings, densities and compositing in float32; only networks run in bfloat16. Times are of one forward "
            "and backward pass, variants in turn. Kernels in float64 run by their reference, which their time does not "
            "flatter. Gradients of fields with ReLUs jump: in float32 a few points fall on the other side of a kink, "
            "which is all of their error of about 1e-3."
        ),
        tables=[Table("Errors and times", rows)],
        plots=[_plot(rows, "value_error", "value"), _plot(rows, "gradient_error", "gradient"), _time_plot(rows)],
        findings=_findings(rows),
    )


def parts(count: int, seed: int) -> dict[str, Part]:
    """Name and maker of every part: a dtype -> a function and its inputs, the first of which is differentiated."""
    generator = torch.Generator().manual_seed(seed)
    positions = 2.4 * torch.rand(count, 3, generator=generator) - 1.2
    directions = nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    times = torch.rand(count, generator=generator)
    box = [[-1.5] * 3, [1.5] * 3]
    levels = GridLevels((16, 32, 64, 128), 1 << 17)
    table = torch.randn(levels.num_rows, 8, generator=generator)
    torch.manual_seed(seed)
    grid = GridField(box)
    nn.init.normal_(grid.table, std=0.1)
    nerf, deformation = NeRFField(), DisplacementDeformation(3, 64, (), position_frequencies=3, time_frequencies=5)
    assert deformation.mlp.output is not None
    nn.init.normal_(deformation.mlp.output.weight, std=0.1)
    flow = FlowDeformation(smooth_network(), 0.5, solver="midpoint", num_steps=4)
    density = 10 ** (6 * torch.rand(count // 64, 64, generator=generator) - 4)
    rgb = torch.rand(count // 64, 64, 3, generator=generator)

    def of_network(module: nn.Module, call: Callable[..., Tensor]) -> Part:
        def make(dtype: torch.dtype) -> tuple[Callable[..., Tensor], list[Tensor]]:
            own = copy.deepcopy(module).to(dtype)
            return (lambda *x: call(own, *x)), [x.to(dtype) for x in (positions, directions, times)]

        return make

    def plain(call: Callable[..., Tensor], *inputs: Tensor) -> Part:
        return lambda dtype: (call, [x.to(dtype) for x in inputs])

    return {
        "compositing": plain(_composited, density, rgb),
        "sinusoidal encoding": of_network(SinusoidalEncoding(3, 10), lambda m, x, d, t: m(x)),
        "grid encoding": plain(lambda x, w: grid_encode(x / 3 + 0.5, w, levels), positions, table),
        "deformation network": of_network(deformation, lambda m, x, d, t: m(x, t)),
        "flow, 4 midpoint steps": of_network(flow, lambda m, x, d, t: m(x, t)),
        "grid field, density": of_network(grid, lambda m, x, d, t: m.density(x, t)),
        "grid field, colour": of_network(grid, lambda m, x, d, t: m(x, d, t).rgb),
        "NeRF field, density": of_network(nerf, lambda m, x, d, t: m.density(x, t)),
        "NeRF field, colour": of_network(nerf, lambda m, x, d, t: m(x, d, t).rgb),
    }


def _composited(density: Tensor, rgb: Tensor) -> Tensor:
    edges = torch.arange(density.shape[1] + 1, dtype=density.dtype) / 64
    edges = edges.expand(len(density), -1)
    return composite(Samples(edges[:, :-1], edges[:, 1:], len(density)), FieldOutput(density, rgb)).rgb


def _context(precision: str) -> AbstractContextManager[Any]:
    if precision == "float64":
        return use_backend("reference")
    return torch.autocast("cpu", torch.bfloat16) if precision == "bfloat16 autocast" else nullcontext()


def _rows(name: str, part: Part, settings: Settings) -> list[dict[str, Any]]:
    calls: dict[str, Callable[[], tuple[Tensor, Tensor]]] = {}
    for precision in PRECISIONS:
        function, inputs = part(torch.float64 if precision == "float64" else torch.float32)

        def call(
            function: Callable[..., Tensor] = function, inputs: list[Tensor] = inputs, precision: str = precision
        ) -> tuple[Tensor, Tensor]:
            first = inputs[0].detach().requires_grad_()
            with _context(precision):
                value = function(first, *inputs[1:])
                (gradient,) = torch.autograd.grad(value.sum(), first)
            return value.detach().double(), gradient.double()

        calls[precision] = call
    results = {precision: call() for precision, call in calls.items()}
    timings = time_in_turn(calls, seconds=0.3 if settings.quick else 1.5, min_repeats=3)
    truth = results["float64"]
    return [_row(name, p, results[p], truth, timings[p], timings["float32"]) for p in PRECISIONS]


def _row(
    name: str, precision: str, result: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor], timing: Timing,
    single: Timing,
) -> dict[str, Any]:  # fmt: skip
    errors = [
        float((own - exact).square().mean().sqrt() / exact.square().mean().sqrt()) for own, exact in zip(result, truth)
    ]
    return {
        "part": name,
        "precision": precision,
        "value_error": errors[0] if precision != "float64" else 0.0,
        "gradient_error": errors[1] if precision != "float64" else 0.0,
        "finite": bool(torch.isfinite(result[0]).all() and torch.isfinite(result[1]).all()),
        **timing.milliseconds,
        "times_float32": timing.median / single.median,
    }


def _time_plot(rows: list[dict[str, Any]]) -> BarPlot:
    names = list(dict.fromkeys(row["part"] for row in rows))
    values = {
        precision: [
            next(r["times_float32"] for r in rows if r["part"] == n and r["precision"] == precision) for n in names
        ]
        for precision in PRECISIONS[1:]
    }
    return BarPlot(
        "precision_time", "Time of a forward and backward pass against float32", "times as long as float32",
        names, values, note="Below 1 is quicker than float32.",
    )  # fmt: skip


def _plot(rows: list[dict[str, Any]], column: str, what: str) -> BarPlot:
    names = list(dict.fromkeys(row["part"] for row in rows))
    values = {
        precision: [next(r[column] for r in rows if r["part"] == n and r["precision"] == precision) for n in names]
        for precision in PRECISIONS[1:]
    }
    return BarPlot(
        f"precision_{what}", f"Relative error of the {what} against float64",
        "root mean square error relative to the root mean square (logarithmic)", names, values, log=True,
    )  # fmt: skip


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for row in rows:
        if row["precision"] == "bfloat16 autocast" and row["value_error"] > 1e-4:
            findings.append(
                f"{row['part']}: bfloat16 costs {row['value_error']:.1e} of the value and {row['gradient_error']:.1e} "
                f"of the gradient, and takes {row['times_float32']:.2f} times as long as float32."
            )
    worst = max((row for row in rows if row["precision"] == "float32"), key=lambda row: row["value_error"])
    return [f"Largest error of float32: {worst['part']}, {worst['value_error']:.1e} of the value.", *findings]
