# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `march`: where a ray goes is `course`'s."""

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from .course import (
    RAYS_AT_ONCE,
    TESTED_AT_ONCE,
    block_bounds,
    cells_of_workers,
    course_of,
    interval,
    next_kept,
    ray_ranges,
)
from .launch import BORROWS, kernel, launch, num_threads
from .rows import trailing_zeros
from .skip_distances import skip_distances
from .tasks import next_task, none_taken


def march(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
    max_samples_per_ray: int | None,
    skips: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    o, d, t0, t1, times_, jitter_, box = (
        x.detach().contiguous().numpy() for x in (origins, directions, near, far, times, jitter, aabb)
    )
    size = o.dtype.type(step)
    ranges = np.empty((len(o), 3), o.dtype)
    counts = np.empty(len(o), np.int64)
    launch(ray_ranges, o, d, t0, t1, jitter_, box, size, ranges, counts)

    kept = np.zeros((len(o), (counts.max(initial=0) + 63) // 64), np.uint64)
    offsets = torch.zeros(len(o) + 1, dtype=torch.int64)
    limit = np.iinfo(np.int64).max if max_samples_per_ray is None else max_samples_per_ray
    grid = occupancy.contiguous().numpy()
    if skips is None:
        skips = skip_distances(occupancy)
    reach = skips.contiguous().numpy()
    bounds = np.empty((len(grid), 3, 2), np.int64)
    launch(block_bounds, reach, bounds)
    slabs = grid.reshape(len(grid), -1)
    arguments = (o, d, t0, times_, jitter_, slabs, grid.shape[1:], reach, bounds, box, size, limit, ranges, counts)
    launch(_mark, *arguments, kept, offsets.numpy(), cells_of_workers(num_threads()), none_taken())
    torch.cumsum(offsets, 0, out=offsets)

    num_samples = int(offsets[-1])
    starts, ends = origins.new_empty(num_samples), origins.new_empty(num_samples)
    ray_indices = offsets.new_empty(num_samples)
    arrays = (starts.numpy(), ends.numpy(), ray_indices.numpy())
    launch(_fill, t0, jitter_, size, ranges, kept, offsets.numpy(), *arrays)
    return starts, ends, ray_indices, offsets


# No fast-math in this file: intervals must round like those of the definition.
@kernel(**BORROWS)
def _mark(
    origins: Any,
    directions: Any,
    near: Any,
    times: Any,
    jitter: Any,
    occupancy: Any,
    shape: Any,
    skips: Any,
    bounds: Any,
    aabb: Any,
    step: Any,
    limit: int,
    ranges: Any,
    counts: Any,
    kept: Any,
    offsets: Any,
    cells: Any,
    taken: Any,
) -> None:
    """Set a bit for every kept interval, and count them.

    A ray is followed through the bounds of its slab's occupied blocks; one that misses them costs nothing. From an
    empty block the march jumps over the intervals whose midpoints are certain to lie in empty blocks too.
    Midpoints round monotonically, and so do the cells computed from them; the margins exceed the rounding of the
    distance to where the empty blocks end. So the result is that of testing every interval.
    """
    num_workers = len(cells)
    num_groups = (len(near) + RAYS_AT_ONCE - 1) // RAYS_AT_ONCE
    for worker in prange(num_workers):
        group = next_task(taken)
        while group < num_groups:
            for r in range(group * RAYS_AT_ONCE, min((group + 1) * RAYS_AT_ONCE, len(near))):
                slab = min(max(int(times[r] * near.dtype.type(occupancy.shape[0])), 0), occupancy.shape[0] - 1)
                j, count, course = course_of(
                    origins[r], directions[r], near[r], jitter[r], step, ranges[r], counts[r], shape, bounds[slab], aabb
                )  # fmt: skip
                found = 0
                while found < limit:
                    j, bits = next_kept(j, count, course, occupancy[slab], skips[slab], cells[worker])
                    if bits == 0:
                        break
                    while bits and found < limit:
                        k = j + int(trailing_zeros(bits))
                        kept[r, k >> 6] |= np.uint64(1) << np.uint64(k & 63)
                        bits &= bits - np.uint64(1)
                        found += 1
                    j += TESTED_AT_ONCE
                offsets[r + 1] = found
            group = next_task(taken)


@kernel(**BORROWS)
def _fill(
    near: Any,
    jitter: Any,
    step: Any,
    ranges: Any,
    kept: Any,
    offsets: Any,
    starts: Any,
    ends: Any,
    ray_indices: Any,
) -> None:
    dtype = near.dtype.type
    for r in prange(len(near)):
        i = offsets[r]
        for word in range(kept.shape[1]):
            bits = kept[r, word]
            while bits:
                j = (word << 6) + int(trailing_zeros(bits))
                bits &= bits - np.uint64(1)
                index = ranges[r, 2] + dtype(j)
                starts[i], ends[i] = interval(near[r], jitter[r], step, ranges[r, 0], ranges[r, 1], index)
                ray_indices[i] = r
                i += 1
