# mypy: disallow_untyped_defs=False, disallow_incomplete_defs=False
"""Triton version of `march`: one program per ray, a lane per interval."""

from functools import lru_cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from dnerf.core.fixed_size import spread

from ..march import interval_ranges

BLOCK = 64
RANGES = 5  # place of the rays' ranges among the kernel's arguments
# Fused multiply-adds would round differently from the definition.
OPTIONS = {"num_warps": 1, "enable_fp_fusion": False}


def march(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: float, limit: int | None, skips: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    near = rays[2]
    arguments = _arguments(rays, occupancy, aabb, near.new_full((1,), step))
    limit = torch.iinfo(torch.int64).max if limit is None else limit
    num_rays, offsets = len(near), torch.zeros(len(near) + 1, dtype=torch.int64, device=near.device)
    if num_rays:
        _march[(num_rays,)](*arguments, limit, offsets, near, near, offsets, *occupancy.shape, False, BLOCK, **OPTIONS)
        torch.cumsum(offsets, 0, out=offsets)
    # The number of samples decides the outputs' size: the one point where the host waits for the device.
    num_samples = int(offsets[-1])
    starts, ends = near.new_empty(num_samples), near.new_empty(num_samples)
    ray_indices = offsets.new_empty(num_samples)
    if num_samples:
        outputs = (offsets, starts, ends, ray_indices)
        _march[(num_rays,)](*arguments, limit, *outputs, *occupancy.shape, True, BLOCK, **OPTIONS)
    return starts, ends, ray_indices, offsets


def march_to_size(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    near = rays[2]
    arguments = _arguments(rays, occupancy, aabb, step.reshape(1))
    ranges, limit = arguments[RANGES], torch.iinfo(torch.int64).max
    num_rays, counts = len(near), torch.zeros(len(near) + 1, dtype=torch.int64, device=near.device)
    _march[(num_rays,)](*arguments, limit, counts, near, near, counts, *occupancy.shape, False, BLOCK, **OPTIONS)
    wanted = counts[1:]
    filled, offsets = spread(wanted, size)
    ranges[:, 3] = torch.where(filled == wanted, ranges[:, 3], 0)  # Rays that do not fit look at no interval.
    starts, ends = near.new_zeros(size), near.new_zeros(size)
    indices = torch.repeat_interleave(offsets.diff(), output_size=size)
    outputs = (offsets, starts, ends, torch.empty_like(indices))
    _march[(num_rays,)](*arguments, limit, *outputs, *occupancy.shape, True, BLOCK, **OPTIONS)
    return starts, ends, indices, offsets, wanted.sum()


def _arguments(rays: list[Tensor], occupancy: Tensor, aabb: Tensor, step: Tensor) -> tuple[Tensor, ...]:
    """What the kernel reads, of origins, directions, near, far, times and jitter; `step` is (1,)."""
    origins, directions, near, far, times, jitter = rays
    ranges = torch.stack(interval_ranges(origins, directions, near, far, jitter, aabb, step), -1)
    scale = _shape(tuple(occupancy.shape[1:]), aabb.device, aabb.dtype) / (aabb[1] - aabb[0])
    of_rays = (x.contiguous() for x in (origins, directions, near, times, jitter))
    return *of_rays, ranges, occupancy.contiguous().view(torch.uint8), aabb.contiguous(), scale, step


@lru_cache(maxsize=16)
def _shape(shape: tuple[int, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    """Kept, since a copy from the host would have to be waited for."""
    return torch.tensor(shape, device=device, dtype=dtype)


@triton.jit
def _cell(origins, directions, aabb, scale, ray, middle, axis: tl.constexpr, size: tl.constexpr):
    position = tl.load(origins + ray * 3 + axis) + tl.load(directions + ray * 3 + axis) * middle
    cell = (position - tl.load(aabb + axis)) * tl.load(scale + axis)
    return tl.minimum(tl.maximum(cell, 0.0), size - 1.0).to(tl.int64)


@triton.jit
def _march(
    origins, directions, near, times, jitter, ranges, occupancy, aabb, scale, step, limit, offsets, starts, ends,
    ray_indices, num_slabs: tl.constexpr, nx: tl.constexpr, ny: tl.constexpr, nz: tl.constexpr, fill: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    """Count a ray's kept intervals into `offsets[ray + 1]`, or write them from `offsets[ray]` on."""
    ray = tl.program_id(0).to(tl.int64)
    near_, jitter_, step_ = tl.load(near + ray), tl.load(jitter + ray), tl.load(step)
    enter, leave = tl.load(ranges + ray * 4), tl.load(ranges + ray * 4 + 1)
    first, count = tl.load(ranges + ray * 4 + 2), tl.load(ranges + ray * 4 + 3).to(tl.int64)
    slab = tl.minimum(tl.maximum(tl.load(times + ray) * num_slabs, 0.0), num_slabs - 1.0).to(tl.int64)
    output = tl.load(offsets + ray)
    found = tl.zeros((), tl.int64)
    j = tl.zeros((), tl.int64)
    while (j < count) & (found < limit):
        lanes = j + tl.arange(0, block)
        index = first + lanes.to(near_.dtype)
        start = tl.maximum(near_ + (index - 1 + jitter_) * step_, enter)
        end = tl.minimum(near_ + (index + jitter_) * step_, leave)
        middle = (start + end) * 0.5
        x = _cell(origins, directions, aabb, scale, ray, middle, 0, nx)
        y = _cell(origins, directions, aabb, scale, ray, middle, 1, ny)
        z = _cell(origins, directions, aabb, scale, ray, middle, 2, nz)
        valid = (lanes < count) & (end > start)
        keep = tl.load(occupancy + ((slab * nx + x) * ny + y) * nz + z, valid, 0).to(tl.int64)
        rank = found + tl.cumsum(keep, 0) - keep
        if fill:
            write = (keep != 0) & (rank < limit)
            tl.store(starts + output + rank, start, write)
            tl.store(ends + output + rank, end, write)
            tl.store(ray_indices + output + rank, tl.zeros_like(rank) + ray, write)
        found += tl.sum(keep, 0)
        j += block
    if not fill:
        tl.store(offsets + ray + 1, tl.minimum(found, limit))
