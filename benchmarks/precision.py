"""Float64, float32 and bfloat16 autocast: what each part loses, value and gradient, and what it saves."""

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.flow_rows import smooth_network
from benchmarks.suite import BarPlot, Settings, SuiteResult, Table
from benchmarks.timing import time_in_turn
from dnerf.core.compositing import FieldOutput, composite
from dnerf.core.rays import Samples
from dnerf.deformations import DisplacementDeformation, FlowDeformation
from dnerf.fields import GridField, NeRFField
from dnerf.kernels import GridLevels, grid_encode, use_backend
from dnerf.nn.encodings import SinusoidalEncoding

PRECISIONS = ("float64", "float32", "bfloat16 autocast")
ERROR = "root mean square error relative to the root mean square (logarithmic)"
Part = Callable[[torch.dtype], tuple[Callable[..., Tensor], list[Tensor]]]


def run(settings: Settings) -> SuiteResult:
    """Run every part in every precision on the same numbers."""
    count = 2000 if settings.quick else 20000
    rows = [row for name, part in parts(count, settings.seed).items() for row in _rows(name, part, settings)]
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
        plots=[
            _plot(rows, "value_error", "Relative error of the value against float64", ERROR, log=True),
            _plot(rows, "gradient_error", "Relative error of the gradient against float64", ERROR, log=True),
            _plot(rows, "times_float32", "Time of a forward and backward pass", "times as long as float32", log=False),
        ],
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
            return partial(call, own), [x.to(dtype) for x in (positions, directions, times)]

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


def _value_and_gradient(part: Part, precision: str) -> Callable[[], tuple[Tensor, Tensor]]:
    function, inputs = part(torch.float64 if precision == "float64" else torch.float32)

    def call() -> tuple[Tensor, Tensor]:
        first = inputs[0].detach().requires_grad_()
        with _context(precision):
            value = function(first, *inputs[1:])
            (gradient,) = torch.autograd.grad(value.sum(), first)
        return value.detach().double(), gradient.double()

    return call


def _rows(name: str, part: Part, settings: Settings) -> list[dict[str, Any]]:
    calls = {precision: _value_and_gradient(part, precision) for precision in PRECISIONS}
    results = {precision: call() for precision, call in calls.items()}
    timings = time_in_turn(calls, seconds=0.3 if settings.quick else 1.5, min_repeats=3)
    rows = []
    for precision, (value, gradient) in results.items():
        exact_value, exact_gradient = results["float64"]
        rows.append(
            {
                "part": name,
                "precision": precision,
                "value_error": _error(value, exact_value),
                "gradient_error": _error(gradient, exact_gradient),
                "finite": bool(torch.isfinite(value).all() and torch.isfinite(gradient).all()),
                **timings[precision].milliseconds,
                "times_float32": timings[precision].median / timings["float32"].median,
            }
        )
    return rows


def _error(own: Tensor, exact: Tensor) -> float:
    return float((own - exact).square().mean().sqrt() / exact.square().mean().sqrt())


def _plot(rows: list[dict[str, Any]], column: str, title: str, x_label: str, *, log: bool) -> BarPlot:
    names = list(dict.fromkeys(row["part"] for row in rows))
    found = {(row["part"], row["precision"]): row[column] for row in rows}
    values = {precision: [found[name, precision] for name in names] for precision in PRECISIONS[1:]}
    return BarPlot(f"precision_{column}", title, x_label, names, values, log=log)


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = [
        f"{row['part']}: bfloat16 costs {row['value_error']:.1e} of the value and {row['gradient_error']:.1e} of the "
        f"gradient, and takes {row['times_float32']:.2f} times as long as float32."
        for row in rows
        if row["precision"] == "bfloat16 autocast" and row["value_error"] > 1e-4
    ]
    worst = max((row for row in rows if row["precision"] == "float32"), key=lambda row: row["value_error"])
    return [f"Largest error of float32: {worst['part']}, {worst['value_error']:.1e} of the value.", *findings]
