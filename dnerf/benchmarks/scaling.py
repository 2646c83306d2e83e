"""Time and memory against grid resolution, rays and scene extent: cost must grow with what is occupied."""

import json
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from dnerf.benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from dnerf.benchmarks.timing import fitted_order, time_in_turn
from dnerf.compositing import FieldOutput, composite
from dnerf.fields import GridField
from dnerf.rays import Rays
from dnerf.samplers import OccupancySampler

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
    """Change one size at a time; each setting runs in a process of its own, so that its peak memory is its own."""
    rows = []
    measured: dict[tuple[float, ...], dict[str, Any]] = {}
    for knob in ("extent", "occupied") if settings.quick else KNOBS:
        values = KNOBS[knob][1]
        for value in values[:2] if settings.quick else values:
            sizes = {**BASE, knob: value}
            key = tuple(sizes.values())
            if key not in measured:
                measured[key] = _in_child(knob, sizes, settings)
            rows.append({"knob": knob, "value": value, **measured[key]})
    plots = [_plot(knob, rows, *names) for knob in dict.fromkeys(r["knob"] for r in rows) for names in COLUMNS]
    return SuiteResult(
        title="Scaling: time and memory against grid resolution, rays and scene extent",
        summary=(
            "A ball of matter in a box, known to the occupancy grid; rays aim at the ball's surroundings. One size "
            f"changes at a time, the others are {', '.join(f'{k} {v:g}' for k, v in BASE.items())}; the step is {STEP} "
            "world units whatever the box. Timed are a forward pass without gradients (march, deformation-free grid "
            "field, compositing) and a training step's forward and backward. Memory is the process's peak resident "
            "size above that of the same process before it made anything. Cost should follow the samples, that is what "
            "is occupied: neither the box nor the resolution cubed."
        ),
        tables=[Table("Sizes", rows, "samples: intervals in occupied cells, over the whole batch.")],
        plots=plots,
        findings=_findings(rows),
    )


COLUMNS = (
    ("time", "time per batch (ms)", {"forward": "forward_ms", "forward + backward": "backward_ms"}),
    ("memory", "peak memory above the start (MiB)", {"whole process": "peak_MiB", "grids alone": "grids_MiB"}),
)

CHILD = """
import json, sys
from dnerf.benchmarks.scaling import measure
values = json.loads(sys.argv[1])
print(json.dumps(measure(values["sizes"], values["seconds"], values["seed"], values["device"], values["threads"])))
"""


def _in_child(knob: str, sizes: Mapping[str, float], settings: Settings) -> dict[str, Any]:
    seconds = 0.2 if settings.quick else 0.7
    values = {
        "sizes": sizes, "seconds": seconds, "seed": settings.seed, "device": settings.device,
        "threads": torch.get_num_threads(),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", CHILD, json.dumps(values)], capture_output=True, text=True, check=False
    )  # fmt: skip
    if done.returncode:
        raise ValueError(f"scaling of {knob} to {sizes[knob]:g} failed: {done.stderr.strip().splitlines()[-1]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(sizes: Mapping[str, float], seconds: float, seed: int, device: str, threads: int) -> dict[str, float]:
    """Time and memory of one setting, in this process.

    Args:
        sizes: as in `BASE`.
        seconds: of measuring.
        seed: of the rays.
        device: where.
        threads: of torch.
    """
    torch.set_num_threads(threads)
    before = _peak_mib(device)
    torch.manual_seed(seed)
    half = 0.5 * sizes["extent"]
    box = [[-half] * 3, [half] * 3]
    sampler = OccupancySampler(box, STEP, int(sizes["occupancy_resolution"]), num_slabs=16).to(device)
    _occupy(sampler, sizes["occupied"])
    finest = int(sizes["grid_resolution"])
    field = GridField(box, (16, 32, 64, finest) if finest > 64 else (8, 16, finest)).to(device)
    rays = _rays(int(sizes["rays"]), sizes["occupied"], half).to(device)

    def render() -> Tensor:
        samples = sampler(rays, field)
        output: FieldOutput = field(*samples.locate(rays))
        return composite(samples, output, torch.ones(3, device=device)).rgb

    def forward() -> Tensor:
        with torch.no_grad():
            return render()

    def backward() -> None:
        field.zero_grad(set_to_none=True)
        render().sum().backward()

    sampler.eval()
    timings = time_in_turn({"forward": forward, "backward": backward}, seconds=seconds, min_repeats=3, device=device)
    grids = [sampler.occupied, sampler.maxima, sampler.skips, field.table]
    return {
        "samples": float((sampler(rays, field).lengths > 0).sum()),
        "occupied_share": float(sampler.occupied.float().mean()),
        "forward_ms": 1e3 * timings["forward"].median,
        "forward_low_ms": 1e3 * timings["forward"].low,
        "forward_high_ms": 1e3 * timings["forward"].high,
        "backward_ms": 1e3 * timings["backward"].median,
        "backward_low_ms": 1e3 * timings["backward"].low,
        "backward_high_ms": 1e3 * timings["backward"].high,
        "peak_MiB": _peak_mib(device) - before,
        "grids_MiB": sum(g.nbytes for g in grids) / 2**20,
    }


def _occupy(sampler: OccupancySampler, radius: float) -> None:
    """Mark the cells that a ball about the origin touches."""
    cells = sampler.occupied.shape[1:]
    side = (sampler.box[1] - sampler.box[0]) / torch.tensor(cells, device=sampler.box.device)
    places = [torch.arange(n, device=sampler.box.device) + 0.5 for n in cells]
    axes = [sampler.box[0, k] + place * side[k] for k, place in enumerate(places)]
    distance = torch.stack(torch.meshgrid(*axes, indexing="ij")).norm(dim=0)
    sampler.occupy(distance <= radius + 0.5 * side.norm())


def _rays(count: int, radius: float, half: float) -> Rays:
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1) * 2 * half
    targets = 2 * radius * (2 * torch.rand(count, 3) - 1)
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return Rays(origins, directions, torch.rand(count), torch.zeros(count), torch.full((count,), 6 * half))


def _peak_mib(device: str) -> float:
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    # Not getrusage: on Linux that begins with what the parent held, see `runs`.
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM")) / 1024


def _plot(knob: str, rows: list[dict[str, Any]], name: str, y_label: str, columns: Mapping[str, str]) -> Plot:
    part = [row for row in rows if row["knob"] == knob]
    x = [row["value"] for row in part]
    series = []
    for label, column in columns.items():
        low, high = (column.replace("_ms", f"_{end}_ms") for end in ("low", "high"))
        ends = [None if end not in part[0] else [row[end] for row in part] for end in (low, high)]
        series.append(Series(label, x, [row[column] for row in part], ends[0], ends[1]))
    if name == "time":
        scale = part[0]["forward_ms"] / max(part[0]["samples"], 1)
        series.append(
            Series("in proportion to the samples", x, [scale * row["samples"] for row in part], style="guide")
        )
    return Plot(
        name=f"scaling_{knob}_{name}",
        title=f"{name.capitalize()} against {KNOBS[knob][0].partition(' (')[0]}",
        x_label=KNOBS[knob][0],
        y_label=y_label,
        series=series,
    )


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for knob, (label, _) in KNOBS.items():
        part = [row for row in rows if row["knob"] == knob]
        if len(part) < 2:
            continue
        values = [float(row["value"]) for row in part]
        powers = {
            what: -fitted_order(values, [max(float(row[column]), 1e-9) for row in part])
            for what, column in (("samples", "samples"), ("forward time", "forward_ms"), ("memory", "peak_MiB"))
        }
        listed = ", ".join(f"{what} to the power {power:.2f}" for what, power in powers.items())
        findings.append(f"With the {label.partition(' (')[0]} ({values[0]:g} to {values[-1]:g}) grow: {listed}.")
    return findings
