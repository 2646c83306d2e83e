"""numba version of `skip_distances`."""

from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ..skip_distances import BLOCK_BITS, MAX_DISTANCE, blocks_shape
from .launch import kernel, launch


def skip_distances(occupancy: Tensor) -> Tensor:
    out = torch.empty(blocks_shape(occupancy), dtype=torch.uint8)
    launch(_any, occupancy.contiguous().view(torch.uint8).numpy(), out.numpy())
    launch(_distances, out.numpy())
    return out


@kernel()
def _any(cells: Any, out: Any) -> None:
    """0 for a block with an occupied cell, the largest distance for the others."""
    nk, bx, by, bz = out.shape
    nx, ny, nz = cells.shape[1:]
    for row in prange(nk * bx):
        k, x = row // bx, row % bx
        line = np.empty(bz << BLOCK_BITS, np.uint8)
        for y in range(by):
            line[:] = 0
            for i in range(x << BLOCK_BITS, min((x + 1) << BLOCK_BITS, nx)):
                for j in range(y << BLOCK_BITS, min((y + 1) << BLOCK_BITS, ny)):
                    for z in range(nz):
                        line[z] |= cells[k, i, j, z]
            for z in range(bz):
                occupied = line[z << BLOCK_BITS : (z + 1) << BLOCK_BITS].any()
                out[k, x, y, z] = 0 if occupied else MAX_DISTANCE


@kernel()
def _distances(out: Any) -> None:
    """Chebyshev distances by two raster sweeps (Rosenfeld and Pfaltz 1966), exact with all 26 neighbours."""
    nk, bx, by, bz = out.shape
    for k in prange(nk):
        for sweep in range(2):
            for n in range(bx * by * bz):
                i = n if sweep == 0 else bx * by * bz - 1 - n
                x, y, z = i // (by * bz), i // bz % by, i % bz
                nearest = np.int64(out[k, x, y, z])
                for p in range(max(x - 1, 0), min(x + 2, bx)):
                    for q in range(max(y - 1, 0), min(y + 2, by)):
                        for r in range(max(z - 1, 0), min(z + 2, bz)):
                            nearest = min(nearest, np.int64(out[k, p, q, r]) + 1)
                out[k, x, y, z] = nearest
