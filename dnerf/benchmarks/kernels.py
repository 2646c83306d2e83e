"""Each kernel against its definition, against the best plain-torch form and against the machine's limit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from dnerf.benchmarks.machine import Rates, measure_rates
from dnerf.benchmarks.suite import Plot, Series, Settings, SuiteResult, Table
from dnerf.benchmarks.timing import num_threads, time_in_turn
from dnerf.geometry import cube_corners
from dnerf.kernels import (
    GridLevels,
    brick_lookup,
    grid_encode,
    march,
    packed_sum,
    packed_weights,
    skip_distances,
    use_backend,
)
from dnerf.kernels.brick_lookup import BRICK, VERTICES
from dnerf.kernels.grid_encode import HASH_PRIMES
from dnerf.rays import Rays

COMPILED = "compiled"
REFERENCE = "reference"
PLAIN = "plain torch"
RESOLUTIONS = (16, 32, 64, 128)
NUM_FEATURES = 8
MAX_ROWS = 1 << 17
STEP = 0.03
LATTICE = 384  # cells per side of the bricks' lattice
CONTENTS = 16  # numbers of each of its vertices
ALONE = ("march", "brick_lookup")  # have no quicker form in plain torch than their definition

Call = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """One kernel at work.

    Args:
        kernel: its name.
        direction: "forward" or "forward + backward".
        calls: what to time, by variant; `COMPILED` and `REFERENCE` among them.
        num_bytes: read and written at the very least: inputs, outputs and table rows that are used, once each.
    """

    kernel: str
    direction: str
    calls: dict[str, Call]
    num_bytes: float


def run(settings: Settings) -> SuiteResult:
    """Time every kernel, forward and backward, on the samples of a batch of rays through a hollow ball."""
    counts = (256, 1024) if settings.quick else (512, 2048, 8192)
    cores = torch.get_num_threads()
    rates = measure_rates(settings.device, seconds=0.15 if settings.quick else 1.0)
    rows: list[dict[str, Any]] = []
    for num_rays in counts:
        workload = Workload(num_rays, settings)
        for threads in [cores] if cores == 1 or num_rays != counts[-1] else [1, cores]:
            with num_threads(threads):
                for case in workload.cases():
                    rows += _measure(case, workload.num_samples, threads, rates, settings)
    largest = max(row["samples"] for row in rows)
    return SuiteResult(
        title="Kernels: compiled, by definition, in plain torch, and the machine's limit",
        summary=(
            "Every kernel of `dnerf/kernels` is timed on the samples of rays through an occupied spherical shell, as a "
            "training step of `experiment=fast` has them: the compiled version (numba on the CPU, Triton on a GPU), "
            "the reference that defines it, and the quickest form in plain torch that we know. Variants run in turn; "
            "medians with quartiles. The limit is the least number of bytes (inputs, outputs and table rows in use, "
            "once each) at the copy bandwidth measured in the same run; a gather from a table that fits into a cache "
            "reads each row many times, so no program reaches it."
        ),
        tables=[
            Table("Times", rows, "times_compiled: how many times the compiled version's median; times_limit likewise."),
            Table("Limits measured in this run", rates.rows()),
        ],
        plots=[_plot(rows, direction) for direction in ("forward", "forward + backward")],
        findings=_findings([row for row in rows if row["samples"] == largest and row["threads"] == cores]),
    )


class Workload:
    """Rays, occupancy, grid and samples that all kernels are timed on.

    Args:
        num_rays: R.
        settings: seed and device.
    """

    def __init__(self, num_rays: int, settings: Settings) -> None:
        generator = torch.Generator().manual_seed(settings.seed)
        device = settings.device
        origins = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=generator), dim=-1) * 4
        targets = 2 * torch.rand(num_rays, 3, generator=generator) - 1
        directions = torch.nn.functional.normalize(targets - origins, dim=-1)
        times = torch.rand(num_rays, generator=generator)
        near = torch.full((num_rays,), 2.0)
        self.rays = Rays(origins, directions, times, near, near + 4).to(device)
        self.jitter = torch.rand(num_rays, generator=generator).to(device)
        axis = (torch.arange(64, device=device) + 0.5) / 32 - 1
        radius = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).norm(dim=0) * 1.5
        self.occupancy = ((radius > 0.7) & (radius < 0.9)).expand(16, 64, 64, 64).contiguous()
        self.skips = skip_distances(self.occupancy)
        self.box = torch.tensor([[-1.5] * 3, [1.5] * 3], device=device)
        self.marched = self._march()
        self.num_samples = len(self.marched.starts)
        middles = 0.5 * (self.marched.starts + self.marched.ends)
        index = self.marched.ray_indices
        positions = self.rays.origins[index] + middles[:, None] * self.rays.directions[index]
        self.positions = (positions / 3 + 0.5).contiguous()
        self.levels = GridLevels(RESOLUTIONS, MAX_ROWS)
        self.table = torch.randn(self.levels.num_rows, NUM_FEATURES, generator=generator).to(device)
        self.cells = self.positions * LATTICE
        side = LATTICE // BRICK
        needed = (self.cells / BRICK).long().clamp(0, side - 1)
        self.slots = torch.full((side,) * 3, -1, device=device)
        self.slots[needed.unbind(-1)] = 0
        places = (self.slots == 0).nonzero()
        self.slots[places.unbind(-1)] = torch.arange(len(places), device=device)
        self.bricks = torch.randn(len(places), VERTICES, CONTENTS, generator=generator).to(device)
        self.depth = torch.rand(self.num_samples, generator=generator).to(device)
        self.values = torch.rand(self.num_samples, 5, generator=generator).to(device)
        self.weights = packed_weights(self.depth, self.marched.offsets)

    def _march(self) -> Any:
        r = self.rays
        return march(
            r.origins, r.directions, r.near, r.far, times=r.times, jitter=self.jitter, occupancy=self.occupancy,
            aabb=self.box, step=STEP, skips=self.skips,
        )  # fmt: skip

    def _used_vertices(self) -> int:
        """Vertices of the bricks' lattice that the samples' cells have."""
        x, y, z = (self.cells.long()[:, None] + cube_corners(self.cells.device)).unbind(-1)
        return int(torch.unique((x * (LATTICE + 1) + y) * (LATTICE + 1) + z).numel())

    def cases(self) -> list[Case]:
        """All kernels, forward and (where there is one) backward."""
        offsets, n = self.marched.offsets, 4 * self.num_samples
        used_rows = sum(int(torch.unique(rows).numel()) for rows, _ in corner_rows(self.positions, self.levels))
        features = self.levels.num_levels * NUM_FEATURES
        grid_bytes = 3 * n + 4 * NUM_FEATURES * used_rows + features * n
        # Backward: the features' gradient and the positions again, the rows again, both gradients written.
        grid_back = grid_bytes + features * n + 6 * n + 4 * NUM_FEATURES * used_rows + self.table.nbytes
        out = 5 * 4 * len(self.rays)
        cases = [
            Case("march", "forward", _backends(self._march), 40 * len(self.rays) + (4 + 4 + 8) * self.num_samples),
            Case(
                "brick_lookup",
                "forward",
                _backends(lambda: brick_lookup(self.cells, self.slots, self.bricks)),
                (4 * (3 + CONTENTS) + 1) * self.num_samples + 4 * CONTENTS * self._used_vertices(),
            ),
            *_both(
                "grid_encode",
                lambda p, t: grid_encode(p, t, self.levels),
                lambda p, t: plain_grid_encode(p, t, self.levels),
                (self.positions, self.table),
                (grid_bytes, grid_back),
            ),
            *_both(
                "packed_weights",
                lambda d: packed_weights(d, offsets),
                lambda d: plain_packed_weights(d, self.marched.ray_indices, offsets),
                (self.depth,),
                (2 * n, 6 * n),
            ),
            *_both(
                "packed_sum",
                lambda v, w: packed_sum(v, w, offsets),
                lambda v, w: torch.segment_reduce(v * w[:, None], "sum", offsets=offsets, axis=0),
                (self.values, self.weights),
                (6 * n + out, 18 * n + 2 * out),
            ),
        ]
        return cases


def _backends(call: Call) -> dict[str, Call]:
    def by_definition() -> Any:
        with use_backend("reference"):
            return call()

    return {COMPILED: call, REFERENCE: by_definition}


def _both(
    kernel: str,
    function: Callable[..., Tensor],
    plain: Callable[..., Tensor],
    inputs: Sequence[Tensor],
    num_bytes: tuple[float, float],
) -> list[Case]:
    """A differentiable kernel's two cases."""
    leaves = [x.detach().clone().requires_grad_() for x in inputs]

    def forward(op: Callable[..., Tensor]) -> Call:
        def call() -> Tensor:
            with torch.no_grad():
                return op(*inputs)

        return call

    def backward(op: Callable[..., Tensor]) -> Call:
        def call() -> Any:
            out = op(*leaves)
            return torch.autograd.grad(out, leaves, torch.ones_like(out))

        return call

    return [
        Case(kernel, "forward", {**_backends(forward(function)), PLAIN: forward(plain)}, num_bytes[0]),
        Case(kernel, "forward + backward", {**_backends(backward(function)), PLAIN: backward(plain)}, num_bytes[1]),
    ]


def corner_rows(positions: Tensor, levels: GridLevels) -> list[tuple[Tensor, Tensor]]:
    """Per level, the table rows (N, 8) of each position's cell and their trilinear weights (N, 8)."""
    corners = torch.tensor([(k & 1, k >> 1 & 1, k >> 2) for k in range(8)], device=positions.device)
    found = []
    for rx, ry, rz, offset, mask in levels.describe():
        cells = torch.tensor((rx, ry, rz), device=positions.device)
        scaled = positions.clamp(0, 1) * cells
        lower = scaled.detach().long().minimum(cells - 1)
        fraction = (scaled - lower)[:, None]
        weights = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        x, y, z = (lower[:, None] + corners).unbind(-1)
        hashed = (x * HASH_PRIMES[0] ^ y * HASH_PRIMES[1] ^ z * HASH_PRIMES[2]) & mask
        found.append((offset + (hashed if mask >= 0 else x + (rx + 1) * (y + (ry + 1) * z)), weights))
    return found


def plain_grid_encode(positions: Tensor, table: Tensor, levels: GridLevels) -> Tensor:
    """`grid_encode` as one `embedding_bag` over all levels: torch's own fused gather and weighted sum."""
    rows, weights = (torch.stack(x, 1) for x in zip(*corner_rows(positions, levels)))
    summed = embedding_bag(rows.reshape(-1, 8), table, mode="sum", per_sample_weights=weights.reshape(-1, 8))
    return summed.reshape(len(positions), -1)


def plain_packed_weights(optical_depth: Tensor, ray_indices: Tensor, offsets: Tensor) -> Tensor:
    """`packed_weights` from one cumulative sum over all rays, in float64 since float32 loses all precision."""
    total = torch.cat([optical_depth.new_zeros(1, dtype=torch.float64), optical_depth.double().cumsum(0)])
    before = (total[:-1] - total[offsets[ray_indices]]).to(optical_depth.dtype)
    return torch.exp(-before) * -torch.expm1(-optical_depth)


def _measure(case: Case, samples: int, threads: int, rates: Rates, settings: Settings) -> list[dict[str, Any]]:
    seconds = 0.3 if settings.quick else 1.0
    timings = time_in_turn(case.calls, seconds=seconds, min_repeats=3, device=settings.device)
    limit = case.num_bytes / rates.bandwidth
    return [
        {
            "kernel": case.kernel,
            "direction": case.direction,
            "samples": samples,
            "threads": threads,
            "variant": variant,
            **timing.milliseconds,
            "times_compiled": timing.median / timings[COMPILED].median,
            "limit_ms": 1e3 * limit,
            "times_limit": timing.median / limit,
        }
        for variant, timing in timings.items()
    ]


def _plot(rows: list[dict[str, Any]], direction: str) -> Plot:
    """Nanoseconds per sample of every kernel's variants against the number of samples."""
    cores = max(row["threads"] for row in rows)
    chosen = [row for row in rows if row["direction"] == direction and row["threads"] == cores]
    series = []
    for color, kernel in enumerate(dict.fromkeys(row["kernel"] for row in chosen)):
        for variant in (COMPILED, PLAIN) if kernel not in ALONE else (COMPILED, REFERENCE):
            part = [row for row in chosen if row["kernel"] == kernel and row["variant"] == variant]
            xs = [row["samples"] for row in part]
            ys, low, high = (
                [1e6 * row[k] / row["samples"] for row in part] for k in ("median_ms", "low_ms", "high_ms")
            )
            style = "line" if variant == COMPILED else "dashed"
            series.append(Series(f"{kernel}, {variant}", xs, ys, low, high, style=style, color=color))
    return Plot(
        name="kernels_" + direction.replace(" + ", "_"),
        title=f"Cost of a sample, {direction}, {cores} thread{'s' * (cores > 1)}",
        x_label="samples in the batch",
        y_label="time per sample (ns)",
        series=series,
        note="Solid: the compiled kernel; dashed: the best form in plain torch (the definition, where there is no "
        "other). Band: quartiles. Lower is better; a flat line means that cost grows with samples alone.",
    )


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    findings = []
    for kernel, direction in dict.fromkeys((row["kernel"], row["direction"]) for row in rows):
        part = {r["variant"]: r for r in rows if r["kernel"] == kernel and r["direction"] == direction}
        others = [f"{v} takes {part[v]['times_compiled']:.3g} x as long" for v in (REFERENCE, PLAIN) if v in part]
        own = part[COMPILED]
        findings.append(
            f"{kernel}, {direction}, {own['samples']:,} samples: {own['median_ms']:.3g} ms compiled, "
            f"{own['times_limit']:.3g} x its least traffic; {', '.join(others)}."
        )
    return findings
