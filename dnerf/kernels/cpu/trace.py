# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `trace`."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..brick_lookup import BRICK_BITS
from ..trace import DONE, LACKS_BRICK, LACKS_VERTEX, LOOK_AHEAD
from .brick_lookup import rows_of
from .course import (
    LINE,
    RAYS_AT_ONCE,
    TESTED_AT_ONCE,
    block_bounds,
    cells_of_workers,
    course_of,
    ends_of,
    next_kept,
    ray_ranges,
)
from .exponential import sigmoid
from .frame_lookup import GOES_ON, NUM_ADDED, added, brick_at, find, log_density_at, opacity_of, place_at, sum_of_terms
from .launch import BORROWS, kernel, launch, num_threads
from .rows import trailing_zeros
from .tasks import next_task, none_taken

SAMPLES_AT_ONCE = 8  # of a ray: while one is waiting for memory, the others are


def trace(
    numbers: Tensor, rays: list[Tensor], tables: list[Tensor], splits: int, scalars: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    origins, directions, near, far, states = rays
    occupancy, skips, aabb, displacements, is_known, low, sides, slots, bricks, brick_low, waves = tables
    step, min_weight, split_weight, cells_per_unit, log_shift, stop_transmittance = scalars
    states, numbers = states.clone(memory_format=torch.contiguous_format), numbers.clone()
    vertices, wanted = torch.zeros_like(is_known), torch.zeros_like(slots, dtype=torch.bool)
    o, d, t0, t1, box = (x.contiguous().numpy() for x in (origins, directions, near, far, aabb))
    zeros, size = np.zeros_like(t0), np.float32(step)
    ranges, counts = np.empty((len(o), 3), o.dtype), np.empty(len(o), np.int64)
    launch(ray_ranges, o, d, t0, t1, zeros, box, size, ranges, counts)
    reach = skips.contiguous().numpy()
    bounds = np.empty((1, 3, 2), np.int64)
    launch(block_bounds, reach[None], bounds)
    table, known, low_, sides_, slots_, brick_low_, waves_ = (
        x.contiguous().numpy() for x in (displacements, is_known, low, sides, slots, brick_low, waves)
    )
    launch(
        _trace,
        (o, d, t0, ranges, counts),
        (occupancy.contiguous().view(-1).numpy(), tuple(occupancy.shape), reach, bounds[0], box, size),
        (table, known, low_, sides_),
        (slots_, rows_of(bricks), brick_low_, np.float32(cells_per_unit), waves_, np.float32(log_shift)),
        (
            splits, np.float32(min_weight), np.float32(split_weight), np.float32(stop_transmittance),
            np.float32(_faint(min_weight, step)),
        ),
        states.numpy(),
        numbers.numpy(),
        vertices.numpy(),
        wanted.numpy(),
        _scratch(num_threads(), max(SAMPLES_AT_ONCE, splits), bricks.shape[2], table.shape[1]),
        none_taken(),
        (0,) * table.shape[1],
        (0,) * bricks.shape[2],
    )  # fmt: skip
    return states, numbers, vertices.view(-1), wanted


def _faint(min_weight: float, step: float) -> float:
    """The logarithm of a density of which no interval's weight exceeds `min_weight`, with room for rounding."""
    return math.log(min_weight / step) - 1e-3 if min_weight > 0 else -math.inf


def _scratch(num_workers: int, size: int, num_contents: int, num_moved: int) -> tuple[np.ndarray, ...]:
    """Each worker's: ends of intervals; their numbers, rows and parts' rows; fractions and what is added; contents; a
    row of the lattice; cells."""
    return (
        np.empty((num_workers, size, 2), np.float32),
        np.empty((num_workers, 3, size), np.int64),
        np.empty((num_workers, 2, size, 3 + NUM_ADDED), np.float32),
        np.empty((num_workers, num_contents + LINE), np.float32),
        np.empty((num_workers, num_moved + LINE), np.float32),
        cells_of_workers(num_workers),
    )


# No fast-math: intervals and cells must round like those of the definition.
@kernel(**BORROWS)
def _trace(
    rays: Any,
    grid: Any,
    tables: Any,
    contents: Any,
    options: Any,
    states: Any,
    numbers: Any,
    vertices: Any,
    wanted: Any,
    scratch: Any,
    taken: Any,
    columns: Any,
    lanes: Any,
) -> None:
    num_workers = len(scratch[0])
    origins, directions, near, ranges, counts = rays
    occupancy, shape, skips, bounds, aabb, step = grid
    displacements, is_known, low, sides = tables
    splits = options[0]
    num_groups = (len(near) + RAYS_AT_ONCE - 1) // RAYS_AT_ONCE
    for worker in prange(num_workers):
        intervals = scratch[0][worker], scratch[1][worker, 0]
        found, parts = (scratch[1][worker, 1], scratch[2][worker, 0]), (scratch[1][worker, 2], scratch[2][worker, 1])
        lattice = displacements, is_known, low, sides, columns
        values, moved, cells = scratch[3][worker], scratch[4][worker], scratch[5][worker]
        group = next_task(taken)
        while group < num_groups:
            for r in range(group * RAYS_AT_ONCE, min((group + 1) * RAYS_AT_ONCE, len(near))):
                if numbers[r] < 0:
                    continue
                j, count, course = course_of(
                    origins[r], directions[r], near[r], np.float32(0), step, ranges[r], counts[r], shape, bounds, aabb
                )  # fmt: skip
                j, bits, end = max(j, numbers[r]), np.uint64(0), GOES_ON
                while end == GOES_ON:
                    j, bits, size, end = _gather(
                        j, bits, count, course, occupancy, skips, lattice, contents, intervals, found, moved, cells
                    )
                    stopped, why = _composite(
                        size, intervals, found, parts, course, lattice, contents, options, states[r], values,
                        moved, lanes,
                    )  # fmt: skip
                    if why != GOES_ON:
                        j, end = stopped, why
                if end == LACKS_VERTEX:
                    _mark_ahead(j, count, course, occupancy, skips, lattice, splits, vertices, cells)
                if end == LACKS_BRICK:
                    first, last = ends_of(j, course)
                    _mark_brick(first, last, splits, course, lattice, contents, moved, wanted)
                numbers[r] = j if end > GOES_ON else end
            group = next_task(taken)


@njit(forceinline=True, **BORROWS)
def _gather(
    j: int,
    bits: Any,
    count: int,
    course: Any,
    occupancy: Any,
    skips: Any,
    lattice: Any,
    contents: Any,
    intervals: Any,
    found: Any,
    moved: Any,
    cells: Any,
) -> Any:
    """The next intervals of a ray, their contents on their way.

    Returns:
        Where the kept intervals go on, see `next_kept`; or if the ray does not, its next interval and no bits; how many
        were found; and why not more.
    """
    spans, numbers = intervals
    for i in range(SAMPLES_AT_ONCE):
        if bits == 0:
            j, bits = next_kept(j, count, course, occupancy, skips, cells)
            if bits == 0:
                return j, bits, i, DONE
        number = j + int(trailing_zeros(bits))
        start, end = ends_of(number, course)
        why = find(np.float32(0.5) * (start + end), course, lattice, contents, found, i, moved)
        if why != GOES_ON:
            return number, np.uint64(0), i, why
        spans[i, 0], spans[i, 1], numbers[i] = start, end, number
        bits &= bits - np.uint64(1)
        if bits == 0:
            j += TESTED_AT_ONCE
    return j, bits, SAMPLES_AT_ONCE, GOES_ON


@njit(forceinline=True, **BORROWS)
def _composite(
    size: int,
    intervals: Any,
    found: Any,
    parts: Any,
    course: Any,
    lattice: Any,
    contents: Any,
    options: Any,
    state: Any,
    values: Any,
    moved: Any,
    lanes: Any,
) -> Any:
    """Composite gathered intervals behind a ray's state; where it goes no further, and why not."""
    splits, min_weight, split_weight, stop_transmittance, faint = options
    spans, numbers = intervals
    for i in range(size):
        start, end = spans[i]
        log_density = log_density_at(found, i, lattice, contents, values, lanes)
        if splits > 1 and log_density <= faint:
            continue
        opacity = opacity_of(log_density, end - start)
        weight = state[0] * opacity
        if splits == 1 or min_weight < weight <= split_weight:
            _add(state, opacity, np.float32(0.5) * (start + end), found, i, lattice, values, contents[4])
        elif not weight <= min_weight:  # NaN is seen
            length = (end - start) / np.float32(splits)
            for k in range(splits):
                if 2 * k + 1 == splits:  # its middle is the interval's
                    parts[0][k] = found[0][i]
                    for column in range(3 + NUM_ADDED):
                        parts[1][k, column] = found[1][i, column]
                    continue
                why = find(_part(start, k, length), course, lattice, contents, parts, k, moved)
                if why != GOES_ON:
                    return numbers[i], why
            for k in range(splits):
                opacity = opacity_of(log_density_at(parts, k, lattice, contents, values, lanes), length)
                _add(state, opacity, _part(start, k, length), parts, k, lattice, values, contents[4])
        if not state[0] > stop_transmittance:
            return numbers[i], DONE
    return 0, GOES_ON


@njit(forceinline=True, **BORROWS)
def _part(start: Any, k: int, length: Any) -> Any:
    """Where the middle of a part of an interval is."""
    return start + (np.float32(k) + np.float32(0.5)) * length


@njit(**BORROWS)
def _mark_brick(
    start: Any, end: Any, splits: int, course: Any, lattice: Any, contents: Any, moved: Any, wanted: Any
) -> None:
    """Mark the first brick that an interval lacks, in its middle or in those of its parts."""
    length = (end - start) / np.float32(splits)
    for k in range(-1, splits):
        middle = np.float32(0.5) * (start + end) if k < 0 else _part(start, k, length)
        why, (x, y, z), _ = brick_at(middle, course, lattice, contents, moved)
        if why == LACKS_BRICK:
            wanted[x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS] = True
            return


@njit(forceinline=True, **BORROWS)
def _add(state: Any, opacity: Any, distance: Any, found: Any, i: int, lattice: Any, values: Any, waves: Any) -> None:
    """Composite one interval behind a ray's state."""
    num_terms = len(waves)
    weight = state[0] * opacity
    for k in range(1, 4):
        raw = sum_of_terms(values, k * num_terms, waves) + added(found, i, k, lattice)
        state[k] += weight * sigmoid(raw)
    state[4] += weight * distance
    state[0] *= np.float32(1) - opacity


@njit(**BORROWS)
def _mark_ahead(
    j: int,
    count: int,
    course: Any,
    occupancy: Any,
    skips: Any,
    lattice: Any,
    splits: int,
    vertices: Any,
    cells: Any,
) -> None:
    """Mark the unknown vertices around a waiting ray's interval and the next ones."""
    is_known, low, sides = lattice[1:4]
    bits = np.uint64(0)
    for _ in range(LOOK_AHEAD):
        if bits == 0:
            j, bits = next_kept(j, count, course, occupancy, skips, cells)
            if bits == 0:
                return
        start, end = ends_of(j + int(trailing_zeros(bits)), course)
        length = (end - start) / np.float32(splits)
        for k in range(splits + 1):  # the parts' middles, then that of the whole
            middle = np.float32(0.5) * (start + end) if k == splits else _part(start, k, length)
            is_in, _, (x, y, z), _ = place_at(middle, course[:2], is_known.shape, low, sides)
            if is_in:
                _mark(vertices, is_known, x, y, z)
        bits &= bits - np.uint64(1)
        if bits == 0:
            j += TESTED_AT_ONCE


@njit(**BORROWS)
def _mark(vertices: Any, is_known: Any, x: int, y: int, z: int) -> None:
    """Mark those vertices of a cell that are not known; several threads may mark the same."""
    for c in range(z, z + 2):
        for b in range(y, y + 2):
            for a in range(x, x + 2):
                if not is_known[c, b, a]:
                    vertices[c, b, a] = True
