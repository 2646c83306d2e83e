# mypy: disable-error-code="call-arg,var-annotated"
"""Which intervals of a ray are kept, for the numba versions of `march` and `trace_network`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit, prange

from ..skip_distances import BLOCK_BITS
from .launch import BORROWS, kernel, launch

TESTED_AT_ONCE = 32  # intervals of a ray, by vector instructions; few rays want fewer
RAYS_AT_ONCE = 64  # neighbours, dealt out to threads in turn: bodies fill the middle of an image
LINE = 32  # numbers between what two workers write, so that they share no line of a cache


def new_cells(num_workers: int) -> np.ndarray:
    """Each one's scratch for `next_kept`."""
    return np.empty((num_workers, TESTED_AT_ONCE + LINE), np.int32)


def ranges_and_bounds(rays: Sequence[np.ndarray], aabb: Any, step: Any, skips: Any) -> tuple[Any, Any, Any]:
    """What `_ranges` finds of origins, directions, near, far and jitter (R, 3) and (R,), and `_bounds` (K, 3, 2)."""
    ranges, counts = np.empty((len(rays[0]), 3), rays[0].dtype), np.empty(len(rays[0]), np.int64)
    launch(_ranges, *rays, aabb, step, ranges, counts)
    bounds = np.empty((len(skips), 3, 2), np.int64)
    launch(_bounds, skips, bounds)
    return ranges, counts, bounds


# No fast-math in this file: intervals and cells must round like those of the definition.
@kernel(**BORROWS)
def _ranges(
    origins: Any, directions: Any, near: Any, far: Any, jitter: Any, aabb: Any, step: Any, ranges: Any, counts: Any
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


@njit(forceinline=True, **BORROWS)
def interval(near: Any, jitter: Any, step: Any, enter: Any, leave: Any, index: Any) -> Any:
    """Where the interval of a number begins and ends."""
    one = type(near)(1)
    start = near + (index - one + jitter) * step
    end = near + (index + jitter) * step
    return max(start, enter), min(end, leave)


@kernel(**BORROWS)
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


@njit(**BORROWS)
def _clip(near: Any, far: Any, position: Any, speed: Any, dilation: Any, bounds: Any, size: int) -> Any:
    """The part of [near, far] in which `position + speed t` may lie, on one axis, in the cells of the bounds."""
    dtype = type(position)
    # Cells beyond the grid count as those of its faces.
    low = dtype(bounds[0] << BLOCK_BITS) - dilation if bounds[0] > 0 else dtype(-np.inf)
    high = dtype(bounds[1] << BLOCK_BITS) + dilation if bounds[1] << BLOCK_BITS < size else dtype(np.inf)
    if bounds[0] >= bounds[1] or (speed == 0 and not low <= position <= high):
        return near, dtype(-np.inf)
    if speed == 0:
        return near, far
    a, b = (low - position) / speed, (high - position) / speed
    return max(near, min(a, b)), min(far, max(a, b))


@njit(**BORROWS)
def course_of(
    origin: Any, direction: Any, near: Any, jitter: Any, step: Any, span: Any, count: Any, shape: Any, bounds: Any,
    aabb: Any,
) -> Any:  # fmt: skip
    """The first interval that may be kept, the one after the last, and what `next_kept` has to know of a ray.

    Args:
        origin, direction, near, jitter, step: of the ray and its intervals.
        span, count: entry, exit, number of the first interval, and how many there may be, see `_ranges`.
        shape, aabb: Gx, Gy, Gz of the grid, and its box (2, 3).
        bounds: (3, 2), the slab's, see `_bounds`.
    """
    dtype = type(near)
    rounding = dtype(8) * dtype(np.finfo(dtype).eps)
    nx, ny, nz = shape
    enter, leave, first = span
    ox, oy, oz = origin
    dx, dy, dz = direction
    scale_x = dtype(nx) / (aabb[1, 0] - aabb[0, 0])
    scale_y = dtype(ny) / (aabb[1, 1] - aabb[0, 1])
    scale_z = dtype(nz) / (aabb[1, 2] - aabb[0, 2])
    margin_x = _margin(rounding, ox, dx, aabb[0, 0], scale_x, leave, nx)
    margin_y = _margin(rounding, oy, dy, aabb[0, 1], scale_y, leave, ny)
    margin_z = _margin(rounding, oz, dz, aabb[0, 2], scale_z, leave, nz)
    slack = rounding * max(abs(near), abs(leave)) + dtype(1e-3) * step
    course = (
        (ox, oy, oz), (dx, dy, dz), (aabb[0, 0], aabb[0, 1], aabb[0, 2]), (scale_x, scale_y, scale_z),
        (margin_x, margin_y, margin_z), (near, jitter, step, enter, leave, first, slack), (nx, ny, nz),
    )  # fmt: skip
    begin, finish = enter, leave
    u, v, w = (ox - aabb[0, 0]) * scale_x, (oy - aabb[0, 1]) * scale_y, (oz - aabb[0, 2]) * scale_z
    begin, finish = _clip(begin, finish, u, dx * scale_x, margin_x, bounds[0], nx)
    begin, finish = _clip(begin, finish, v, dy * scale_y, margin_y, bounds[1], ny)
    begin, finish = _clip(begin, finish, w, dz * scale_z, margin_z, bounds[2], nz)
    if not begin - slack <= finish + slack:
        return 0, 0, course
    # An interval's middle lies within half a step of its place, also where it is clipped.
    base = near + (first + jitter) * step
    j = max(int((begin - slack - base) / step) - 1, 0)
    return j, min(int(count), max(int((finish + slack - base) / step), 0) + 3), course


@njit(forceinline=True, **BORROWS)
def next_kept(j: int, count: int, course: Any, occupancy: Any, skips: Any, cells: Any) -> Any:
    """From interval j on, where some in a row hold the first kept one, and the bits of those kept; 0 if none is.

    Args:
        j, count: numbers of the interval to begin at, and of the one after the last.
        course: of the ray, see `course_of`.
        occupancy, skips: (Gx Gy Gz,), the ray's slab, and its `skip_distances`.
        cells: (TESTED_AT_ONCE,) int32, scratch.

    Returns:
        The number of the first of `TESTED_AT_ONCE` intervals, and their bits, a uint64.
    """
    bits = np.uint64(0)
    while j < count and bits == 0:
        free = _jump(j, course, skips)
        if free > 0:
            j += free
            continue
        _locate(j, course, cells)
        for k in range(min(TESTED_AT_ONCE, count - j)):
            # Without a branch, which nothing could predict.
            bits |= np.uint64((cells[k] >= 0) & occupancy[max(cells[k], 0)]) << np.uint64(k)
        if bits == 0:
            j += TESTED_AT_ONCE
    return j, bits


@njit(forceinline=True, **BORROWS)
def _locate(j: int, course: Any, cells: Any) -> None:
    """The flat numbers of the cells in which the middles of intervals lie; -1 for intervals of no length."""
    (ox, oy, oz), (dx, dy, dz), (lx, ly, lz), (sx, sy, sz), _, along, (nx, ny, nz) = course
    near, jitter, step, enter, leave, first, _ = along
    dtype = type(near)
    # Plain selections on one type each: this loop becomes vector instructions.
    wide, deep = np.int32(ny), np.int32(nz)
    last_x, last_y, last_z = dtype(nx - 1), dtype(ny - 1), dtype(nz - 1)
    zero, one, half = dtype(0), dtype(1), dtype(0.5)
    for k in range(TESTED_AT_ONCE):
        index = first + dtype(np.int32(j) + np.int32(k))
        start, end = near + (index - one + jitter) * step, near + (index + jitter) * step
        start, end = enter if enter > start else start, leave if leave < end else end
        middle = (start + end) * half
        u, v, w = (ox + dx * middle - lx) * sx, (oy + dy * middle - ly) * sy, (oz + dz * middle - lz) * sz
        u, v, w = u if u > zero else zero, v if v > zero else zero, w if w > zero else zero
        u, v, w = last_x if u > last_x else u, last_y if v > last_y else v, last_z if w > last_z else w
        cell = (np.int32(u) * wide + np.int32(v)) * deep + np.int32(w)
        cells[k] = cell if end > start else np.int32(-1)


@njit(forceinline=True, **BORROWS)
def _jump(j: int, course: Any, skips: Any) -> int:
    """How many intervals from j on certainly lie in empty blocks; 0 in a block that is not empty."""
    origin, direction, low, scale, dilation, along, (nx, ny, nz) = course
    near, jitter, step, enter, leave, first, slack = along
    dtype = type(near)
    half = dtype(0.5)
    index = first + dtype(j)
    start, end = interval(near, jitter, step, enter, leave, index)
    middle = (start + end) * half
    u = (origin[0] + direction[0] * middle - low[0]) * scale[0]
    v = (origin[1] + direction[1] * middle - low[1]) * scale[1]
    w = (origin[2] + direction[2] * middle - low[2]) * scale[2]
    x, y, z = min(max(int(u), 0), nx - 1), min(max(int(v), 0), ny - 1), min(max(int(w), 0), nz - 1)
    radius = int(skips[x >> BLOCK_BITS, y >> BLOCK_BITS, z >> BLOCK_BITS])
    if radius == 0:
        return 0
    free = leave - middle
    free = min(free, _free(u, x, radius, direction[0] * scale[0], dilation[0]))
    free = min(free, _free(v, y, radius, direction[1] * scale[1], dilation[1]))
    free = min(free, _free(w, z, radius, direction[2] * scale[2], dilation[2]))
    edge = near + (index + jitter) * step
    return 1 + max(int((middle + free - slack - edge) / step + half), 0)


@njit(**BORROWS)
def _margin(rounding: Any, o: Any, d: Any, lower: Any, scale: Any, leave: Any, size: int) -> Any:
    """A bound on the rounding of a position inside the box, in cells of one axis."""
    return rounding * (type(o)(size) + scale * (abs(o) + abs(lower) + abs(d) * abs(leave)))


@njit(forceinline=True, **BORROWS)
def _free(position: Any, cell: int, radius: int, speed: Any, dilation: Any) -> Any:
    """Distance along the ray that surely stays, on one axis, within the blocks closer than `radius`."""
    dtype = type(position)
    if speed == 0:
        return dtype(np.inf)
    block = cell >> BLOCK_BITS
    if speed > 0:
        cells = dtype((block + radius) << BLOCK_BITS) - position
    else:
        cells = position - dtype((block - radius + 1) << BLOCK_BITS)
    return max(cells - dilation, dtype(0)) / abs(speed)
