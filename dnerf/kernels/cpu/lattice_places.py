# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `lattice_places`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .course import LINE
from .frame_lookup import blend_vertices, place_at
from .launch import BORROWS, kernel, launch, num_threads
from .tasks import next_task, none_taken

PLACES_AT_ONCE = 512  # dealt out to threads


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
    columns = table.shape[1]
    moved = np.empty((num_threads(), columns + LINE), np.float32)
    launch(_places, o, d, rays, t, table, tuple(shape), low_, sides_, out.numpy(), moved, none_taken(), (0,) * columns)
    return out


# No fast-math: what lies in the lattice is what the definition says.
@kernel(**BORROWS)
def _places(
    origins: Any,
    directions: Any,
    ray_indices: Any,
    distances: Any,
    displacements: Any,
    shape: Any,
    low: Any,
    sides: Any,
    out: Any,
    scratch: Any,
    taken: Any,
    lanes: Any,
) -> None:
    for worker in prange(len(scratch)):
        moved = scratch[worker]
        first = next_task(taken) * PLACES_AT_ONCE
        while first < len(distances):
            for i in range(first, min(first + PLACES_AT_ONCE, len(distances))):
                r = ray_indices[i]
                ray = (
                    (origins[r, 0], origins[r, 1], origins[r, 2]),
                    (directions[r, 0], directions[r, 1], directions[r, 2]),
                )
                is_in, place, cell, fractions = place_at(distances[i], ray, shape, low, sides)
                if is_in:
                    blend_vertices(displacements, shape, cell, fractions, moved, lanes)
                for axis in range(3):
                    out[i, axis] = place[axis] + moved[axis] if is_in else np.float32(np.nan)
            first = next_task(taken) * PLACES_AT_ONCE
