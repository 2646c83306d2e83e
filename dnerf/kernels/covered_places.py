"""Which places of a raster lie in at least one of many boxes."""

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .checks import check_shapes


@torch.no_grad()
def covered_places(lows: Tensor, ends: Tensor, shape: Sequence[int]) -> Tensor:
    """Flat places of a raster that boxes cover; what reaches beyond it is cut off.

    Args:
        lows: (3, M) int64, where each of M boxes begins on each of the raster's axes.
        ends: (3, M) int64, the first place behind it; a box that ends where it begins, or before, holds nothing.
        shape: of the raster, three sizes.

    Returns:
        (K,) int64, in order, each once.

    Raises:
        ValueError: shapes or types that do not fit.
    """
    sizes = tuple(int(size) for size in shape)
    if len(sizes) != 3 or min(sizes) < 0:
        raise ValueError(f"shape must be of three sizes, got {sizes}")
    check_shapes(lows=(lows, (3, "M")), ends=(ends, (3, lows.shape[1])))
    if not lows.dtype == ends.dtype == torch.int64:
        raise ValueError(f"lows and ends must be int64, got {lows.dtype} and {ends.dtype}")
    if lows.is_cpu and choose(lows.new_empty(0, dtype=torch.float32)) == "numba":
        return run_compiled("covered_places", "covered_places", lows, ends, sizes)
    return covered_places_reference(lows, ends, sizes)


def covered_places_reference(lows: Tensor, ends: Tensor, shape: Sequence[int]) -> Tensor:
    """The definition of `covered_places` in plain torch, by summed area tables (Crow 1984).

    How many boxes hold a place is the sum of +1 and -1 at their corners, over all corners before it on every axis.
    """
    sizes = torch.tensor(shape, device=lows.device)[:, None]
    lows, ends = torch.minimum(lows.clamp(min=0), sizes), torch.minimum(ends.clamp(min=0), sizes)
    has_some = (lows < ends).all(0)
    lows, ends = lows[:, has_some], ends[:, has_some]
    changes = torch.zeros([size + 1 for size in shape], dtype=torch.int64, device=lows.device)
    for corner in product((False, True), repeat=3):
        places = tuple(ends[axis] if is_end else lows[axis] for axis, is_end in enumerate(corner))
        changes.index_put_(places, lows.new_tensor((-1) ** sum(corner)), accumulate=True)
    for axis, size in enumerate(shape):
        changes = changes.cumsum(axis).narrow(axis, 0, size)
    return (changes > 0).reshape(-1).nonzero()[:, 0]
