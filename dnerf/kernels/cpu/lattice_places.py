# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `lattice_places`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .cells import PLACES, cell_tables, fractions_at, locate_all, rows_at
from .course import LINE
from .launch import BORROWS, kernel, launch, num_threads
from .rows import blend_rows
from .tasks import next_task, none_taken

NOTHING, ALL = np.float32(0), np.float32(1)
NOWHERE = np.float32(np.nan)  # outside the lattice


def lattice_places(
    origins: Tensor,
    directions: Tensor,
    ray_indices: Tensor,
    distances: Tensor,
    displacements: Tensor,
    shape: Sequence[int],
    low: Tensor,
    sides: Tensor,
) -> Tensor:
    if len(ray_indices):
        first, last = (int(x) for x in ray_indices.aminmax())
        if first < 0 or last >= len(origins):
            raise ValueError(f"ray_indices must lie in [0, {len(origins)}), got {first} to {last}")
    out = origins.new_empty(len(distances), 3)
    o, d, rays, t, table, low_, sides_ = (
        x.detach().contiguous().numpy()
        for x in (origins, directions, ray_indices, distances, displacements, low, sides)
    )
    columns, threads = table.shape[1], num_threads()
    moved = np.empty((threads, columns + LINE), np.float32)
    tables = cell_tables(np.float32, threads)
    level = shape[2] - 1, shape[1] - 1, shape[0] - 1, 0, -1  # of which there is one, as `GridLevels.describe` gives it
    launch(_places, o, d, rays, t, table, level, low_, sides_, out.numpy(), moved, tables, none_taken(), (0,) * columns)
    return out


# No fast-math: what lies in the lattice is what the definition says.
@kernel(**BORROWS)
def _places(
    origins: Any,
    directions: Any,
    ray_indices: Any,
    distances: Any,
    displacements: Any,
    level: Any,
    low: Any,
    sides: Any,
    out: Any,
    scratch: Any,
    tables: Any,
    taken: Any,
    lanes: Any,
) -> None:
    for worker in prange(len(scratch)):
        moved = scratch[worker]
        places, fractions, rows = tables[0][worker], tables[1][worker], tables[2][worker]
        first = next_task(taken) * PLACES
        while first < len(distances):
            count = min(PLACES, len(distances) - first)
            for i in range(count):
                r, t = ray_indices[first + i], distances[first + i]
                for axis in range(3):
                    places[axis, i] = out[first + i, axis] = origins[r, axis] + t * directions[r, axis]
            for axis in range(3):
                line = places[axis]
                for i in range(count):
                    share = (line[i] - low[axis]) / sides[axis]
                    line[i] = share if NOTHING <= share <= ALL else NOWHERE
            locate_all(places, count, level, rows, fractions)
            for i in range(count):
                blend_rows(displacements, 0, rows_at(rows, i), fractions_at(fractions, i), moved, 0, lanes)
                for axis in range(3):
                    out[first + i, axis] += moved[axis]
            first = next_task(taken) * PLACES
