# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `brick_lookup`."""

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..brick_lookup import BRICK, BRICK_BITS, VERTICES
from .launch import FAST, launch
from .rows import blend_rows

SIDE = BRICK + 1


def brick_lookup(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    num_features = bricks.shape[2]
    values = bricks.new_zeros(positions.shape[0], num_features)
    known = torch.zeros(positions.shape[0], dtype=torch.bool)
    table = bricks.contiguous().view(-1, num_features)
    arrays = (x.detach().contiguous().numpy() for x in (positions, slots, table))
    launch(_lookup, *arrays, values.numpy(), known.numpy(), (0,) * num_features)
    return values, known


@njit(parallel=True, cache=True, nogil=True, fastmath=FAST)
def _lookup(positions: Any, slots: Any, table: Any, values: Any, known: Any, lanes: Any) -> None:
    bx, by, bz = slots.shape
    one, zero = positions.dtype.type(1), positions.dtype.type(0)
    for i in prange(positions.shape[0]):
        px, py, pz = positions[i]
        if px >= zero and py >= zero and pz >= zero and px <= bx * BRICK and py <= by * BRICK and pz <= bz * BRICK:
            x, y, z = min(int(px), bx * BRICK - 1), min(int(py), by * BRICK - 1), min(int(pz), bz * BRICK - 1)
            number = slots[x >> BRICK_BITS, y >> BRICK_BITS, z >> BRICK_BITS]
            if number >= 0:
                known[i] = True
                u = px - positions.dtype.type(x)
                v = py - positions.dtype.type(y)
                w = pz - positions.dtype.type(z)
                x, y, z = x & (BRICK - 1), y & (BRICK - 1), z & (BRICK - 1)
                a = np.int64(number * VERTICES + (x * SIDE + y) * SIDE + z)
                b, c = a + SIDE, a + SIDE * SIDE
                d = c + SIDE
                rows = (a, a + 1, b, b + 1, c, c + 1, d, d + 1)
                e, f, g, h = (one - u) * (one - v), (one - u) * v, u * (one - v), u * v
                weights = (e * (one - w), e * w, f * (one - w), f * w, g * (one - w), g * w, h * (one - w), h * w)
                blend_rows(table, rows, weights, values, i * len(lanes), lanes)
