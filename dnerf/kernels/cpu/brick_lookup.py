# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `brick_lookup`; `trace` uses some of its functions."""

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..brick_lookup import BRICK, BRICK_BITS, VERTICES
from .launch import BORROWS, FAST, kernel, launch
from .rows import blend_rows

SIDE = BRICK + 1
# Rows of a cell's eight vertices, from that of the lowest; bit 0 of the vertex number is z, bit 2 x.
CORNERS = tuple((k >> 2) * SIDE * SIDE + (k >> 1 & 1) * SIDE + (k & 1) for k in range(8))


def brick_lookup(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    num_features = bricks.shape[2]
    values = positions.new_zeros(positions.shape[0], num_features)
    known = torch.zeros(positions.shape[0], dtype=torch.bool)
    arrays = (x.detach().contiguous().numpy() for x in (positions, slots))
    launch(_lookup, *arrays, rows_of(bricks), values.numpy(), known.numpy(), (0,) * num_features)
    return values, known


def rows_of(bricks: Tensor) -> np.ndarray:
    """Their vertices' values (M * 729, F), for `blend_rows`."""
    rows = bricks.detach().contiguous().view(-1, bricks.shape[2])
    return (rows.view(torch.uint16) if rows.dtype == torch.float16 else rows).numpy()


@njit(fastmath=FAST, **BORROWS)
def is_inside(px: Any, py: Any, pz: Any, slots: Any) -> bool:
    """Whether a place, in cells, lies in the lattice."""
    bx, by, bz = slots.shape
    zero = type(px)(0)
    return px >= zero and py >= zero and pz >= zero and px <= bx * BRICK and py <= by * BRICK and pz <= bz * BRICK


@njit(fastmath=FAST, **BORROWS)
def cell_of(px: Any, py: Any, pz: Any, slots: Any) -> Any:
    """The cell (x, y, z) of a place in the lattice."""
    bx, by, bz = slots.shape
    return min(int(px), bx * BRICK - 1), min(int(py), by * BRICK - 1), min(int(pz), bz * BRICK - 1)


@njit(fastmath=FAST, **BORROWS)
def first_row(x: int, y: int, z: int, number: int) -> Any:
    """Row of the lowest vertex of a cell, in the brick of that number."""
    x, y, z = x & (BRICK - 1), y & (BRICK - 1), z & (BRICK - 1)
    return np.int64(number * VERTICES + (x * SIDE + y) * SIDE + z)


@kernel(fastmath=FAST, **BORROWS)
def _lookup(positions: Any, slots: Any, table: Any, values: Any, known: Any, lanes: Any) -> None:
    for i in prange(positions.shape[0]):
        px, py, pz = positions[i]
        if is_inside(px, py, pz, slots):
            x, y, z = cell_of(px, py, pz, slots)
            number = slots[x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS]
            if number >= 0:
                known[i] = True
                real = positions.dtype.type
                fractions = pz - real(z), py - real(y), px - real(x)
                row = first_row(x, y, z, number)
                blend_rows(table, row, CORNERS, fractions, values, i * len(lanes), lanes)
