# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `lattice_places`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .cells import PLACES, cell_tables, fractions_at, locate_in_lattice, rows_at
from .course import LINE
from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads, rows_array
from .rows import blend_rows


def lattice_places(
    origins: Tensor, directions: Tensor, ray_indices: Tensor, distances: Tensor, displacements: Tensor,
    shape: Sequence[int], low: Tensor, sides: Tensor,
) -> Tensor:  # fmt: skip
    rays, out = rows_array("ray_indices", ray_indices, len(origins)), origins.new_empty(len(distances), 3)
    o, d, t, table, low_, sides_ = (array(x) for x in (origins, directions, distances, displacements, low, sides))
    lanes, threads = (0,) * table.shape[1], num_threads()
    moved, tables = np.empty((threads, len(lanes) + LINE), np.float32), cell_tables(np.float32, threads)
    level = shape[2] - 1, shape[1] - 1, shape[0] - 1, 0, -1  # of which there is one, as `GridLevels.describe` gives it
    launch(_places, o, d, rays, t, table, level, low_, sides_, out.numpy(), moved, tables, none_taken(), lanes)
    return out


# No fast-math: what lies in the lattice is what the definition says.
@kernel(**BORROWS)
def _places(
    origins: Any, directions: Any, ray_indices: Any, distances: Any, displacements: Any, level: Any, low: Any,
    sides: Any, out: Any, scratch: Any, tables: Any, taken: Any, lanes: Any,
) -> None:  # fmt: skip
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
            locate_in_lattice(places, count, (level, low, sides), rows, fractions)
            for i in range(count):
                blend_rows(displacements, 0, rows_at(rows, i), fractions_at(fractions, i), moved, 0, lanes)
                for axis in range(3):
                    out[first + i, axis] += moved[axis]
            first = next_task(taken) * PLACES
