"""Time and memory of grids against resolution, rays and scene extent: cost must grow with what is occupied."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from benchmarks.timing import fitted_order, time_in_turn
from dnerf.core.compositing import composite
from dnerf.core.rays import Rays
from dnerf.fields import GridField
from dnerf.samplers import OccupancyGrid, OccupancySampler

KNOBS: dict[str, tuple[str, list[float]]] = {
    "occupancy_resolution": ("occupancy cells along a side", [32, 64, 128]),
    "grid_resolution": ("finest feature grid's cells along a side", [32, 128, 512]),
    "rays": ("rays in the batch", [1024, 4096, 16384]),
    "extent": ("side of the box (world units)", [3.0, 6.0, 12.0, 24.0]),
    "occupied": ("radius of the body (world units)", [0.15, 0.3, 0.6, 1.2]),
}
BASE = {"occupancy_resolution": 64, "grid_resolution": 128, "rays": 4096, "extent": 3.0, "occupied": 0.6}
STEP = 0.03


def run(settings: Settings) -> SuiteResult:
    """Change one size at a time."""
    rows: list[dict[str, Any]] = []
    for knob in ("extent", "occupied") if settings.quick else KNOBS:
        values = KNOBS[knob][1]
        for value in values[:2] if settings.quick else values:
            measured = measure({**BASE, knob: value}, 0.2 if settings.quick else 0.7, settings.seed, settings.device)
            rows.append({"knob": knob, "value": value, **measured})
    return SuiteResult(
        title="Scaling: time and memory of grids against resolution, rays and scene extent",
        summary=(
            "A ball in a box, known to the occupancy grid; rays aim at the ball's surroundings. One size changes at a "
            f"time, the others are {', '.join(f'{k} {v:g}' for k, v in BASE.items())}; the step is {STEP} world units "
            "whatever the box. Timed are a forward pass without gradients (march, grid field, compositing) and a "
            "training step's forward and backward. Cost should follow the samples, that is what is occupied: neither "
            "the box nor the resolution cubed."
        ),
        tables=[Table("Sizes", rows, "samples: intervals in occupied cells, over the whole batch.")],
        plots=[_plot(knob, rows) for knob in dict.fromkeys(row["knob"] for row in rows)],
        findings=_findings(rows),
    )


def measure(sizes: Mapping[str, float], seconds: float, seed: int, device: str) -> dict[str, float]:
    """Time and memory of one setting.

    Args:
        sizes: as in `BASE`.
        seconds: of measuring.
        seed: of the rays.
        device: where.
    """
    torch.manual_seed(seed)
    half = 0.5 * sizes["extent"]
    box = [[-half] * 3, [half] * 3]
    grid = OccupancyGrid(box, int(sizes["occupancy_resolution"]), num_slabs=16)
    _occupy(grid, sizes["occupied"])
    sampler = OccupancySampler(grid, STEP).to(device).eval()
    finest = int(sizes["grid_resolution"])
    field = GridField(box, (16, 32, 64, finest) if finest > 64 else (8, 16, finest)).to(device)
    rays = _rays(int(sizes["rays"]), sizes["occupied"], half).to(device)

    def render() -> Tensor:
        samples = sampler(rays, field)
        return composite(samples, field(*samples.locate(rays)), torch.ones(3, device=device)).rgb

    def forward() -> Tensor:
        with torch.no_grad():
            return render()

    def backward() -> None:
        field.zero_grad(set_to_none=True)
        render().sum().backward()

    timings = time_in_turn({"forward": forward, "backward": backward}, seconds=seconds, min_repeats=3, device=device)
    return {
        "samples": float((sampler(rays, field).lengths > 0).sum()),
        "occupied_share": float(grid.occupied.float().mean()),
        **{f"{way}_{name}": value for way, timing in timings.items() for name, value in timing.milliseconds.items()},
        "grids_MiB": sum(g.nbytes for g in (grid.occupied, grid.maxima, grid.skips, field.table)) / 2**20,
    }


def _occupy(grid: OccupancyGrid, radius: float) -> None:
    """Mark the cells that a ball about the origin touches."""
    cells = grid.occupied.shape[1:]
    side = (grid.box[1] - grid.box[0]) / torch.tensor(cells)
    axes = [grid.box[0, k] + (torch.arange(n) + 0.5) * side[k] for k, n in enumerate(cells)]
    distance = torch.stack(torch.meshgrid(*axes, indexing="ij")).norm(dim=0)
    grid.occupy(distance <= radius + 0.5 * side.norm())


def _rays(count: int, radius: float, half: float) -> Rays:
    origins = normalize(torch.randn(count, 3), dim=-1) * 2 * half
    directions = normalize(2 * radius * (2 * torch.rand(count, 3) - 1) - origins, dim=-1)
    return Rays(origins, directions, torch.rand(count), torch.zeros(count), torch.full((count,), 6 * half))


def _plot(knob: str, rows: list[dict[str, Any]]) -> Plot:
    part = [row for row in rows if row["knob"] == knob]
    x = [row["value"] for row in part]
    series = []
    for label, way in (("forward", "forward"), ("forward + backward", "backward")):
        y, low, high = ([row[f"{way}_{end}_ms"] for row in part] for end in ("median", "low", "high"))
        series.append(Series(label, x, y, low, high))
    scale = part[0]["forward_median_ms"] / max(part[0]["samples"], 1)
    in_proportion = [scale * row["samples"] for row in part]
    return Plot(
        name=f"scaling_{knob}",
        title=f"Time against {KNOBS[knob][0].partition(' (')[0]}",
        x_label=KNOBS[knob][0],
        y_label="time per batch (ms)",
        series=[*series, Series("in proportion to the samples", x, in_proportion, style="guide")],
    )


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for knob, (label, _) in KNOBS.items():
        part = [row for row in rows if row["knob"] == knob]
        if not part:
            continue
        values = [float(row["value"]) for row in part]
        powers = {
            what: -fitted_order(values, [max(float(row[column]), 1e-9) for row in part])
            for what, column in (("samples", "samples"), ("forward time", "forward_median_ms"), ("grids", "grids_MiB"))
        }
        listed = ", ".join(f"{what} to the power {power:.2f}" for what, power in powers.items())
        findings.append(f"With the {label.partition(' (')[0]} ({values[0]:g} to {values[-1]:g}) grow: {listed}.")
    return findings
