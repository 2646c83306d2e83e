# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `march`: where a ray goes is `course`'s."""

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from .course import RAYS_AT_ONCE, TESTED_AT_ONCE, course_of, interval, new_cells, next_kept, ranges_and_bounds
from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads
from .rows import trailing_zeros
from .skip_distances import skip_distances


def march(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: float, limit: int | None, skips: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    o, d, t0, t1, times, jitter, box = (array(x) for x in (*rays, aabb))
    size = o.dtype.type(step)
    grid, reach = array(occupancy), array(skip_distances(occupancy) if skips is None else skips)
    ranges, counts, bounds = ranges_and_bounds((o, d, t0, t1, jitter), box, size, reach)

    kept = np.zeros((len(o), (counts.max(initial=0) + 63) // 64), np.uint64)
    offsets = torch.zeros(len(o) + 1, dtype=torch.int64)
    most = np.iinfo(np.int64).max if limit is None else limit
    slabs = grid.reshape(len(grid), -1)
    launch(
        _mark, (o, d, t0, times, jitter, ranges, counts), (slabs, grid.shape[1:], reach, bounds, box, size), most,
        kept, offsets.numpy(), new_cells(num_threads()), none_taken(),
    )  # fmt: skip
    torch.cumsum(offsets, 0, out=offsets)

    num_samples = int(offsets[-1])
    starts, ends = rays[0].new_empty(num_samples), rays[0].new_empty(num_samples)
    ray_indices = offsets.new_empty(num_samples)
    arrays = (starts.numpy(), ends.numpy(), ray_indices.numpy())
    launch(_fill, t0, jitter, size, ranges, kept, offsets.numpy(), *arrays)
    return starts, ends, ray_indices, offsets


# No fast-math in this file: intervals must round like those of the definition.
@kernel(**BORROWS)
def _mark(rays: Any, grid: Any, limit: int, kept: Any, offsets: Any, cells: Any, taken: Any) -> None:
    """Set a bit for every kept interval, and count them.

    A ray is followed through the bounds of its slab's occupied blocks. From an empty block the march jumps over the
    intervals whose midpoints are certain to lie in empty blocks too. Midpoints round monotonically, and so do the cells
    computed from them; the margins exceed the rounding of the distance to where the empty blocks end. So the result is
    that of testing every interval.
    """
    origins, directions, near, times, jitter, ranges, counts = rays
    occupancy, shape, skips, bounds, aabb, step = grid
    num_groups = (len(near) + RAYS_AT_ONCE - 1) // RAYS_AT_ONCE
    for worker in prange(len(cells)):
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
    near: Any, jitter: Any, step: Any, ranges: Any, kept: Any, offsets: Any, starts: Any, ends: Any, ray_indices: Any
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
