"""The work of `suite=kernels` that only images on CPUs need: which pixels, which places, and the fused frame kernel."""

from functools import partial
from typing import Any

import torch

from benchmarks.kernel_cases import STEP, Call, Case, Workload, backends
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.kernels import FrameTables, add_seen, footprints, seen_parts, shade, trace_network

DISPLACEMENTS = 80  # cells per side of the displacements' lattice


def image_cases(work: Workload) -> list[Case]:
    """Kernels that GPUs run by their definition, on the same samples as those of training."""
    return [*_cell_cases(work), *_sample_cases(work)]


def _cell_cases(work: Workload) -> list[Case]:
    """Of a whole grid, whatever the samples."""
    occupied = work.occupancy[0]
    camera = Camera(Intrinsics.from_angle(400, 400, 0.7), look_at((2.5, 2.5, 1.5)))
    view = partial(footprints, occupied, work.box, camera.pose, camera.intrinsics.pinhole, (400, 400))
    covered = view()
    num_pixels = 0 if covered is None else len(covered.pixels)
    return [
        Case("footprints", "forward", backends(view), occupied.nbytes + 16 * num_pixels),
    ]


def _sample_cases(work: Workload) -> list[Case]:
    n, r, found = 4 * work.num_samples, work.rays, work.marched
    thin, light = torch.full_like(work.distances, 5.0), torch.ones_like(r.near)
    sums = torch.zeros(len(r), 5)
    parts = partial(
        seen_parts, found.starts, found.ends, found.offsets, thin, light, subdivision=3, subdivision_weight=0.02,
        min_weight=4e-3,
    )  # fmt: skip
    adding = partial(
        add_seen, sums, torch.arange(len(r)), light, found.starts, found.ends, found.offsets, thin, work.values[:, :3],
    )  # fmt: skip
    products = torch.randn(work.num_samples, 4).bfloat16()
    return [
        Case("seen_parts", "forward", backends(parts), 3 * n + 16 * work.num_samples),
        Case("add_seen", "forward", backends(adding), 6 * n + 2 * sums.nbytes),
        Case("shade", "forward", backends(partial(shade, products, torch.zeros(4), -1.0)), 24 * work.num_samples),
        Case("trace_network", "forward", backends(_tracing(work)), 40 * len(r) + work.used_bytes),
    ]


def _tracing(work: Workload) -> Call:
    """Following the rays through occupied cells: density is low, displacements are zero and steps stay whole."""
    low, sides, side, half = work.box[0], work.box[1] - work.box[0], DISPLACEMENTS + 1, len(work.head) // 2
    tables = FrameTables(
        occupancy=work.occupancy[0], skips=work.skips[0], aabb=work.box, low=low, sides=sides, levels=work.levels,
        displacements=torch.zeros(side**3, 4), is_known=torch.ones(side, side, side, dtype=torch.bool),
        table=work.table, weights=work.head[:half], biases=work.head[half:], field_low=low, field_scale=1 / sides,
        shifts=torch.tensor([-10.0, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    r = work.rays

    def call() -> Any:
        with torch.autocast("cpu", torch.bfloat16):
            return trace_network(
                r.origins, r.directions, r.near, r.far, tables, step=STEP, subdivision=1, min_weight=0.0,
                subdivision_weight=0.0, stop_transmittance=1e-4,
            )  # fmt: skip

    return call
