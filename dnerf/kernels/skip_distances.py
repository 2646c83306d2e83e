"""How far the empty space around each block of an occupancy grid reaches."""

import torch
from torch import Tensor
from torch.nn import functional

from .backend import choose, run_compiled
from .checks import check_cells

BLOCK_BITS = 3
BLOCK = 1 << BLOCK_BITS
MAX_DISTANCE = 255


def blocks_shape(occupancy: Tensor) -> tuple[int, int, int, int]:
    """Shape of an occupancy grid in blocks of 8 cells per axis."""
    k, x, y, z = occupancy.shape
    return k, -(-x // BLOCK), -(-y // BLOCK), -(-z // BLOCK)


@torch.no_grad()
def skip_distances(occupancy: Tensor) -> Tensor:
    """Chebyshev distance from each block of 8 x 8 x 8 cells to the nearest one with an occupied cell.

    All blocks closer than this are empty, and `march` jumps over them.

    Args:
        occupancy: (K, Gx, Gy, Gz) bool.

    Returns:
        (K, ceil(Gx / 8), ceil(Gy / 8), ceil(Gz / 8)) uint8, in blocks: 0 for a block with an occupied cell, 255
        where there is none within reach.

    Raises:
        ValueError: the grid is not bool of four axes.
    """
    check_cells("occupancy", occupancy, "K, Gx, Gy, Gz")
    if occupancy.is_cpu and choose(occupancy.new_empty(0, dtype=torch.float32)) == "numba":
        return run_compiled("skip_distances", "skip_distances", occupancy)
    return skip_distances_reference(occupancy)


def skip_distances_reference(occupancy: Tensor) -> Tensor:
    """The definition of `skip_distances` in plain torch: it grows the occupied blocks one by one."""
    pad = [p for size in reversed(occupancy.shape[1:]) for p in (0, -size % BLOCK)]
    reached = functional.max_pool3d(functional.pad(occupancy, pad).float(), BLOCK)
    distances = torch.zeros(reached.shape, dtype=torch.int64, device=occupancy.device)
    for _ in range(max(reached.shape[1:])):
        distances += reached == 0
        reached = functional.max_pool3d(reached, 3, stride=1, padding=1)
    return distances.masked_fill(reached == 0, MAX_DISTANCE).clamp(max=MAX_DISTANCE).to(torch.uint8)
