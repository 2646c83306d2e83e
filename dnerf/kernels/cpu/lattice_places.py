# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `lattice_places`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .course import LINE
from .grid_encode import locate, trilinear_weights
from .launch import BORROWS, kernel, launch, num_threads
from .rows import blend_rows
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
    one, zero = np.float32(1), np.float32(0)
    _, ly, lx = shape
    for worker in prange(len(scratch)):
        moved = scratch[worker]
        first = next_task(taken) * PLACES_AT_ONCE
        while first < len(distances):
            for i in range(first, min(first + PLACES_AT_ONCE, len(distances))):
                r, t = ray_indices[i], distances[i]
                px = origins[r, 0] + t * directions[r, 0]
                py = origins[r, 1] + t * directions[r, 1]
                pz = origins[r, 2] + t * directions[r, 2]
                u, v, w = (px - low[0]) / sides[0], (py - low[1]) / sides[1], (pz - low[2]) / sides[2]
                if not (zero <= u <= one and zero <= v <= one and zero <= w <= one):
                    out[i, 0] = out[i, 1] = out[i, 2] = np.float32(np.nan)
                    continue
                x, u = locate(u, lx - 1)
                y, v = locate(v, ly - 1)
                z, w = locate(w, shape[0] - 1)
                a = np.int64(x + lx * (y + ly * z))
                b, c = a + lx, a + lx * ly
                e = c + lx
                rows = (a, a + 1, b, b + 1, c, c + 1, e, e + 1)
                blend_rows(displacements, rows, trilinear_weights(u, v, w), moved, 0, lanes)
                out[i, 0], out[i, 1], out[i, 2] = px + moved[0], py + moved[1], pz + moved[2]
            first = next_task(taken) * PLACES_AT_ONCE
