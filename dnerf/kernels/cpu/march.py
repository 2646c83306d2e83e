# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `march`."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..skip_distances import BLOCK_BITS
from .launch import launch
from .rows import trailing_zeros
from .skip_distances import skip_distances


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
    launch(_ranges, o, d, t0, t1, jitter_, box, size, ranges, counts)

    kept = np.zeros((len(o), (counts.max(initial=0) + 63) // 64), np.uint64)
    offsets = torch.zeros(len(o) + 1, dtype=torch.int64)
    limit = np.iinfo(np.int64).max if max_samples_per_ray is None else max_samples_per_ray
    grid = occupancy.contiguous().numpy()
    if skips is None:
        skips = skip_distances(occupancy)
    reach = skips.contiguous().numpy()
    bounds = np.empty((len(grid), 3, 2), np.int64)
    launch(_bounds, reach, bounds)
    arguments = (o, d, t0, times_, jitter_, grid, reach, bounds, box, size, limit, ranges, counts)
    launch(_mark, *arguments, kept, offsets.numpy())
    torch.cumsum(offsets, 0, out=offsets)

    num_samples = int(offsets[-1])
    starts, ends = origins.new_empty(num_samples), origins.new_empty(num_samples)
    ray_indices = offsets.new_empty(num_samples)
    arrays = (starts.numpy(), ends.numpy(), ray_indices.numpy())
    launch(_fill, t0, jitter_, size, ranges, kept, offsets.numpy(), *arrays)
    return starts, ends, ray_indices, offsets


# No fast-math in this file: intervals and cells must round like those of the definition.
@njit(parallel=True, cache=True, nogil=True)
def _ranges(
    origins: Any,
    directions: Any,
    near: Any,
    far: Any,
    jitter: Any,
    aabb: Any,
    step: Any,
    ranges: Any,
    counts: Any,
) -> None:
    """Per ray: entry, exit and number of the first interval, and how many intervals there may be."""
    for r in prange(len(near)):
        enter, leave = near[r], far[r]
        finite = True
        for a in range(3):
            o, d = origins[r, a], directions[r, a]
            finite = finite and math.isfinite(o) and math.isfinite(d)
            if d == 0:
                if o < aabb[0, a] or o > aabb[1, a]:
                    finite = False
            else:
                lower, upper = (aabb[0, a] - o) / d, (aabb[1, a] - o) / d
                enter = max(enter, min(lower, upper))
                leave = min(leave, max(lower, upper))
        length = leave - enter
        hit = finite and length > 0 and math.isfinite(length)
        ranges[r, 0], ranges[r, 1] = enter, leave
        ranges[r, 2] = math.floor((enter - near[r]) / step - jitter[r]) if hit else 0
        counts[r] = math.ceil(length / step) + 3 if hit else 0


@njit
def _interval(near: Any, jitter: Any, step: Any, enter: Any, leave: Any, index: Any) -> Any:
    one = type(near)(1)
    start = near + (index - one + jitter) * step
    end = near + (index + jitter) * step
    return max(start, enter), min(end, leave)


@njit(parallel=True, cache=True, nogil=True)
def _bounds(skips: Any, bounds: Any) -> None:
    """Per slab and axis: the first block with an occupied cell and the one after the last; empty where none is."""
    nk, bx, by, bz = skips.shape
    for k in prange(nk):
        bounds[k, 0], bounds[k, 1], bounds[k, 2] = (bx, 0), (by, 0), (bz, 0)
        for x in range(bx):
            for y in range(by):
                for z in range(bz):
                    if skips[k, x, y, z] == 0:
                        for axis, block in enumerate((x, y, z)):
                            bounds[k, axis, 0] = min(bounds[k, axis, 0], block)
                            bounds[k, axis, 1] = max(bounds[k, axis, 1], block + 1)


@njit(error_model="numpy")
def _clip(near: Any, far: Any, position: Any, speed: Any, margin: Any, bounds: Any, size: int) -> Any:
    """The part of [near, far] in which `position + speed t` may lie, on one axis, in the cells of the bounds."""
    dtype = type(position)
    # Cells beyond the grid count as those of its faces.
    low = dtype(bounds[0] << BLOCK_BITS) - margin if bounds[0] > 0 else dtype(-np.inf)
    high = dtype(bounds[1] << BLOCK_BITS) + margin if bounds[1] << BLOCK_BITS < size else dtype(np.inf)
    if bounds[0] >= bounds[1] or (speed == 0 and not low <= position <= high):
        return near, dtype(-np.inf)
    if speed == 0:
        return near, far
    a, b = (low - position) / speed, (high - position) / speed
    return max(near, min(a, b)), min(far, max(a, b))


@njit(parallel=True, cache=True, nogil=True)
def _mark(
    origins: Any,
    directions: Any,
    near: Any,
    times: Any,
    jitter: Any,
    occupancy: Any,
    skips: Any,
    bounds: Any,
    aabb: Any,
    step: Any,
    limit: int,
    ranges: Any,
    counts: Any,
    kept: Any,
    offsets: Any,
) -> None:
    """Set a bit for every kept interval, and count them.

    A ray is followed through the bounds of its slab's occupied blocks; one that misses them costs nothing. From an
    empty block the march jumps over the intervals whose midpoints are certain to lie in empty blocks too.
    Midpoints round monotonically, and so do the cells computed from them; the margins exceed the rounding of the
    distance to where the empty blocks end. So the result is that of testing every interval.
    """
    dtype = near.dtype.type
    half, rounding = dtype(0.5), dtype(8) * dtype(np.finfo(dtype).eps)
    num_slabs = occupancy.shape[0]
    nx, ny, nz = occupancy.shape[1:]
    scale_x = dtype(nx) / (aabb[1, 0] - aabb[0, 0])
    scale_y = dtype(ny) / (aabb[1, 1] - aabb[0, 1])
    scale_z = dtype(nz) / (aabb[1, 2] - aabb[0, 2])
    for r in prange(len(near)):
        enter, leave, first = ranges[r]
        slab = min(max(int(times[r] * dtype(num_slabs)), 0), num_slabs - 1)
        ox, oy, oz = origins[r]
        dx, dy, dz = directions[r]
        margin_x = _margin(rounding, ox, dx, aabb[0, 0], scale_x, leave, nx)
        margin_y = _margin(rounding, oy, dy, aabb[0, 1], scale_y, leave, ny)
        margin_z = _margin(rounding, oz, dz, aabb[0, 2], scale_z, leave, nz)
        slack = rounding * max(abs(near[r]), abs(leave)) + dtype(1e-3) * step
        begin, finish = enter, leave
        u, v, w = (ox - aabb[0, 0]) * scale_x, (oy - aabb[0, 1]) * scale_y, (oz - aabb[0, 2]) * scale_z
        begin, finish = _clip(begin, finish, u, dx * scale_x, margin_x, bounds[slab, 0], nx)
        begin, finish = _clip(begin, finish, v, dy * scale_y, margin_y, bounds[slab, 1], ny)
        begin, finish = _clip(begin, finish, w, dz * scale_z, margin_z, bounds[slab, 2], nz)
        if not begin - slack <= finish + slack:
            offsets[r + 1] = 0
            continue
        # An interval's middle lies within half a step of its place, also where it is clipped.
        base = near[r] + (first + jitter[r]) * step
        found = 0
        j = max(int((begin - slack - base) / step) - 1, 0)
        count = min(counts[r], max(int((finish + slack - base) / step), 0) + 3)
        while j < count and found < limit:
            index = first + dtype(j)
            start, end = _interval(near[r], jitter[r], step, enter, leave, index)
            middle = (start + end) * half
            u = (ox + dx * middle - aabb[0, 0]) * scale_x
            v = (oy + dy * middle - aabb[0, 1]) * scale_y
            w = (oz + dz * middle - aabb[0, 2]) * scale_z
            x, y, z = min(max(int(u), 0), nx - 1), min(max(int(v), 0), ny - 1), min(max(int(w), 0), nz - 1)
            radius = int(skips[slab, x >> BLOCK_BITS, y >> BLOCK_BITS, z >> BLOCK_BITS])
            if radius == 0:
                if end > start and occupancy[slab, x, y, z]:
                    kept[r, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
                    found += 1
                j += 1
            else:
                free = leave - middle
                free = min(free, _free(u, x, radius, dx * scale_x, margin_x))
                free = min(free, _free(v, y, radius, dy * scale_y, margin_y))
                free = min(free, _free(w, z, radius, dz * scale_z, margin_z))
                edge = near[r] + (index + jitter[r]) * step
                j += 1 + max(int((middle + free - slack - edge) / step + half), 0)
        offsets[r + 1] = found


@njit
def _margin(rounding: Any, o: Any, d: Any, lower: Any, scale: Any, leave: Any, size: int) -> Any:
    """A bound on the rounding of a position inside the box, in cells of one axis."""
    return rounding * (type(o)(size) + scale * (abs(o) + abs(lower) + abs(d) * abs(leave)))


@njit(error_model="numpy")
def _free(position: Any, cell: int, radius: int, speed: Any, margin: Any) -> Any:
    """Distance along the ray that surely stays, on one axis, within the blocks closer than `radius`."""
    dtype = type(position)
    if speed == 0:
        return dtype(np.inf)
    block = cell >> BLOCK_BITS
    if speed > 0:
        cells = dtype((block + radius) << BLOCK_BITS) - position
    else:
        cells = position - dtype((block - radius + 1) << BLOCK_BITS)
    return max(cells - margin, dtype(0)) / abs(speed)


@njit(parallel=True, cache=True, nogil=True)
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
                starts[i], ends[i] = _interval(near[r], jitter[r], step, ranges[r, 0], ranges[r, 1], index)
                ray_indices[i] = r
                i += 1
