# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `trace_network`: many rays of a thread's at once, each at its next interval."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..shade import MOST_LOG_DENSITY
from ..trace_network import NUM_STATES, FrameTables
from .cells import PLACES, cell_tables, clamped, fractions_at, locate_in_lattice, rows_at
from .course import LINE, RAYS_AT_ONCE, TESTED_AT_ONCE, course_of, interval, new_cells, next_kept, ranges_and_bounds
from .exponential import exp, expm1, sigmoid
from .grid_network import ROOM, ask_network, network_of, room_of, rounded
from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads
from .rows import blend_rows, trailing_zeros

MOST = np.float32(MOST_LOG_DENSITY)
LEFT_OUT, WHOLE, CUT, ELSEWHERE = 0, 1, 2, 3
UNKNOWN = 4  # the line of values behind density and colours
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)


def trace_network(
    basis: Tensor, rays: list[Tensor], tables: FrameTables, subdivision: int, scalars: list[float]
) -> tuple[Tensor, Tensor]:
    step, min_weight, subdivision_weight, stop_transmittance = (np.float32(x) for x in scalars)
    o, d, t0, t1 = (array(x) for x in rays)
    states = rays[0].new_zeros(len(o), NUM_STATES)
    states[:, 0] = 1
    is_done = torch.ones(len(o), dtype=torch.bool)
    occupancy, aabb, reach = array(tables.occupancy), array(tables.aabb), array(tables.skips)
    ranges, counts, bounds = ranges_and_bounds((o, d, t0, t1, np.zeros_like(t0)), aabb, step, reach[None])
    weights, biases = rounded(rays[0], tables.weights), rounded(rays[0], tables.biases)
    network, widths = network_of(tables.table, tables.levels.cells, tables.levels.max_rows, weights, biases)
    workers, num_words = num_threads(), (int(counts.max(initial=0)) + TESTED_AT_ONCE) // 64 + 1
    displacements, shape = array(tables.displacements), tables.is_known.shape
    level, columns = (shape[2] - 1, shape[1] - 1, shape[0] - 1, 0, -1), displacements.shape[1]
    launch(
        _trace, (o, d, t0, ranges, counts, array(basis)),
        (occupancy.ravel(), occupancy.shape, reach, bounds[0], aabb, step),
        (displacements, level, array(tables.low), array(tables.sides)),
        (array(tables.field_low), array(tables.field_scale), array(tables.shifts)), network,
        (subdivision, min_weight, subdivision_weight, stop_transmittance), states.numpy(), is_done.numpy(),
        _scratch(workers, subdivision, num_words, columns), room_of(weights, workers),
        cell_tables(np.float32, workers), none_taken(), (0,) * columns, *widths,
    )  # fmt: skip
    return states, is_done


def _scratch(workers: int, subdivision: int, num_words: int, num_moved: int) -> tuple[np.ndarray, ...]:
    """Each worker's, see `_trace`."""
    parts = subdivision * PLACES
    shapes = (2, PLACES), (PLACES, num_words), (2, PLACES), (parts,), (parts,), (5, PLACES), (subdivision, 5, PLACES)
    dtypes = np.int64, np.uint64, np.float32, np.int64, np.float32, np.float32, np.float32
    tables = (np.empty((workers, *shape), dtype) for shape, dtype in zip(shapes, dtypes, strict=True))
    return *tables, np.empty((workers, num_moved + LINE), np.float32), new_cells(workers)


# No fast-math: intervals and cells must round like those of the definition.
@kernel(**BORROWS)
def _trace(
    rays: Any, grid: Any, lattice: Any, field: Any, network: Any, options: Any, states: Any, is_done: Any, scratch: Any,
    room: Any, tables: Any, taken: Any, columns: Any, lanes: Any, group: Any, vectors: Any, last_group: Any,
    last_vectors: Any,
) -> None:  # fmt: skip
    """Each worker has up to `PLACES` rays under way: their `numbers`, the bits of the `kept` intervals that are still
    to come, and of those they are at `spans`, where they begin and how long they are, and what becomes of them."""
    origins, directions, near, ranges, counts, basis = rays
    occupancy, shape, skips, bounds, aabb, step = grid
    displacements, level, low, sides = lattice
    num_groups = (len(near) + RAYS_AT_ONCE - 1) // RAYS_AT_ONCE
    for worker in prange(len(room[0])):
        numbers, kinds = scratch[0][worker, 0], scratch[0][worker, 1]
        kept, spans = scratch[1][worker], scratch[2][worker]
        owners, distances = scratch[3][worker], scratch[4][worker]  # of the places that are evaluated
        values, part_values = scratch[5][worker], scratch[6][worker]
        moved, cells = scratch[7][worker], scratch[8][worker]
        asked = (
            (origins, directions, numbers, owners, distances), (displacements, level, low, sides, columns, moved),
            (*field, basis), (network, (lanes, group, vectors, last_group, last_vectors)),
            (tables[0][worker], tables[1][worker], tables[2][worker]),
            (room[0][worker], room[1][worker], room[2][worker]),
        )  # fmt: skip
        active, r, last, has_more = 0, 0, 0, True
        while True:
            while has_more and active < PLACES:
                if r == last:
                    task = next_task(taken)
                    has_more = task < num_groups
                    r, last = task * RAYS_AT_ONCE, min((task + 1) * RAYS_AT_ONCE, len(near))
                    continue
                if is_done[r]:
                    j, count, course = course_of(
                        origins[r], directions[r], near[r], ZERO, step, ranges[r], counts[r], shape, bounds, aabb
                    )  # fmt: skip
                    if _mark(j, count, course, occupancy, skips, cells, kept[active]):
                        numbers[active] = r
                        active += 1
                r += 1
            if active == 0:
                break
            for s in range(active):
                n, j = numbers[s], _take(kept[s])
                start, end = interval(near[n], ZERO, step, ranges[n, 0], ranges[n, 1], ranges[n, 2] + np.float32(j))
                spans[0, s], spans[1, s], distances[s], owners[s] = start, end - start, HALF * (start + end), s
            _ask(active, 0, asked, values)
            num_parts = _choose(active, numbers, spans, values, states, options, kinds, owners, distances)
            for first in range(0, num_parts, PLACES):
                _ask(min(PLACES, num_parts - first), first, asked, part_values[first // PLACES])
            _composite(active, numbers, spans, values, part_values, options[0], kinds, states)
            active = _go_on(active, numbers, kept, kinds, states, options[3], is_done)


@njit(**BORROWS)
def _choose(
    active: int, numbers: Any, spans: Any, values: Any, states: Any, options: Any, kinds: Any, owners: Any,
    distances: Any,
) -> int:  # fmt: skip
    """Decide what becomes of intervals; where and of which ray parts of those are that are cut, and how many."""
    subdivision, min_weight, subdivision_weight, _ = options
    num_parts = 0
    for s in range(active):
        if math.isnan(values[UNKNOWN, s]):
            kinds[s] = ELSEWHERE
            continue
        weight = states[numbers[s], 0] * -expm1(-values[0, s] * spans[1, s])
        if subdivision == 1 or min_weight < weight <= subdivision_weight:
            kinds[s] = WHOLE
        elif weight <= min_weight:
            kinds[s] = LEFT_OUT
        else:  # also NaN, which is seen
            kinds[s] = CUT
            length = spans[1, s] / np.float32(subdivision)
            for k in range(subdivision):
                if 2 * k + 1 != subdivision:  # else its middle is the interval's
                    owners[num_parts], distances[num_parts] = s, _part(spans[0, s], k, length)
                    num_parts += 1
    return num_parts


@njit(**BORROWS)
def _composite(
    active: int, numbers: Any, spans: Any, values: Any, part_values: Any, subdivision: int, kinds: Any, states: Any
) -> None:
    """Composite intervals and parts behind their rays' states; a ray of which a part is not known goes elsewhere."""
    part = 0
    for s in range(active):
        state, start, length = states[numbers[s]], spans[0, s], spans[1, s]
        if kinds[s] == WHOLE:
            _add(state, values, s, start + HALF * length, length)
        if kinds[s] != CUT:
            continue
        length /= np.float32(subdivision)
        for k in range(subdivision):
            if 2 * k + 1 == subdivision:
                _add(state, values, s, _part(start, k, length), length)
                continue
            found, i = part_values[part // PLACES], part % PLACES
            _add(state, found, i, _part(start, k, length), length)
            if math.isnan(found[UNKNOWN, i]):
                kinds[s] = ELSEWHERE
            part += 1


@njit(**BORROWS)
def _go_on(active: int, numbers: Any, kept: Any, kinds: Any, states: Any, stop_transmittance: Any, is_done: Any) -> int:
    """Let rays that have ended leave, the last ones taking their places; how many go on."""
    s = 0
    while s < active:
        if kinds[s] == ELSEWHERE:
            is_done[numbers[s]] = False
        elif states[numbers[s], 0] > stop_transmittance and _any(kept[s]):
            s += 1
            continue
        active -= 1
        numbers[s], kinds[s] = numbers[active], kinds[active]
        for k in range(kept.shape[1]):
            kept[s, k] = kept[active, k]
    return active


@njit(**BORROWS)
def _mark(j: int, count: int, course: Any, occupancy: Any, skips: Any, cells: Any, kept: Any) -> bool:
    """Set the bits of a ray's kept intervals; whether there are any."""
    for k in range(len(kept)):
        kept[k] = 0
    while True:
        j, bits = next_kept(j, count, course, occupancy, skips, cells)
        if bits == 0:
            return _any(kept)
        word, shift = j >> 6, j & 63
        kept[word] |= bits << np.uint64(shift)
        if shift > 64 - TESTED_AT_ONCE:
            kept[word + 1] |= bits >> np.uint64(64 - shift)
        j += TESTED_AT_ONCE


@njit(**BORROWS)
def _take(kept: Any) -> int:
    """The number of the first interval, whose bit is cleared."""
    word = 0
    while kept[word] == 0:
        word += 1
    number = (word << 6) + int(trailing_zeros(kept[word]))
    kept[word] &= kept[word] - np.uint64(1)
    return number


@njit(**BORROWS)
def _any(kept: Any) -> bool:
    """Whether any bit is set."""
    bits = np.uint64(0)
    for k in range(len(kept)):
        bits |= kept[k]
    return bits != 0


@njit(**BORROWS)
def _ask(count: int, first: int, asked: Any, values: Any) -> None:
    """Density and colours at so many places, from one on, and what is NaN where nothing is known of them: (5, n)."""
    (origins, directions, numbers, owners, distances), lattice, field, nets, work, own = asked
    field_low, scale, shifts, basis = field
    displacements, level, low, sides, columns, moved = lattice
    places, fractions, rows = work
    encoded, hidden, found = own
    for i in range(count):
        r, t = numbers[owners[first + i]], distances[first + i]
        for axis in range(3):
            places[axis, i] = values[1 + axis, i] = origins[r, axis] + t * directions[r, axis]
    locate_in_lattice(places, count, (level, low, sides), rows, fractions)
    for i in range(count):
        blend_rows(displacements, 0, rows_at(rows, i), fractions_at(fractions, i), moved, 0, columns)
        total = ZERO
        for axis in range(3):
            place = (values[1 + axis, i] + moved[axis] - field_low[axis]) * scale[axis]
            places[axis, i] = clamped(place)
            total += place
        values[UNKNOWN, i] = total - total  # NaN of what is no number
    ask_network(count, nets[0], nets[1], work, encoded, hidden, found)
    _look(count, basis, numbers, owners[first:], shifts, found, values)
    densities = values[0, :count]
    for i in range(len(densities)):
        densities[i] = exp(MOST if densities[i] > MOST else densities[i])
    for k in range(1, 4):
        colors = values[k, :count]
        for i in range(len(colors)):
            colors[i] = sigmoid(colors[i])


@njit(**BORROWS)
def _look(count: int, basis: Any, numbers: Any, owners: Any, shifts: Any, found: Any, values: Any) -> None:
    """Before their activations, density and the colours that each place's ray sees: sums over its harmonics."""
    width, terms = len(found) // ROOM, basis.shape[1]
    for i in range(count):
        start, seen = i * width, basis[numbers[owners[i]]]
        values[0, i] = found[start] + shifts[0]
        for c in range(3):
            at = 1 + c * terms
            total = found[start + at] + shifts[at]  # the first harmonic is one
            for k in range(1, terms):
                total += seen[k] * (found[start + at + k] + shifts[at + k])
            values[1 + c, i] = total


@njit(forceinline=True, **BORROWS)
def _part(start: Any, k: int, length: Any) -> Any:
    """Where the middle of a part of an interval is."""
    return start + (np.float32(k) + HALF) * length


@njit(forceinline=True, **BORROWS)
def _add(state: Any, values: Any, i: int, distance: Any, length: Any) -> None:
    """Composite one interval behind a ray's state."""
    opacity = -expm1(-values[0, i] * length)
    weight = state[0] * opacity
    for k in range(1, 4):
        state[k] += weight * values[k, i]
    state[4] += weight * distance
    state[0] *= ONE - opacity
