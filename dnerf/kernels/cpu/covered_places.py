"""numba version of `covered_places`."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .launch import BORROWS, array, kernel


def covered_places(lows: Tensor, ends: Tensor, shape: tuple[int, ...]) -> Tensor:
    out = torch.empty(math.prod(shape), dtype=torch.int64)
    changes, is_touched = np.empty((*shape[:2], shape[2] + 1), np.int32), np.zeros(shape[:2], np.bool_)
    return out[: _covered(array(lows), array(ends), changes, is_touched, out.numpy())]


# One thread: starting a second one takes as long as half of this.
@kernel(parallel=False, **BORROWS)
def _covered(lows: Any, ends: Any, changes: Any, is_touched: Any, out: Any) -> int:
    """Note in each row where boxes begin and end, then walk along the rows that some box meets."""
    nx, ny, nz = changes.shape[0], changes.shape[1], changes.shape[2] - 1
    for i in range(lows.shape[1]):
        begin, end = max(lows[2, i], 0), min(ends[2, i], nz)
        if begin >= end:
            continue
        for x in range(max(lows[0, i], 0), min(ends[0, i], nx)):
            for y in range(max(lows[1, i], 0), min(ends[1, i], ny)):
                if not is_touched[x, y]:
                    is_touched[x, y] = True
                    changes[x, y] = 0
                changes[x, y, begin] += 1
                changes[x, y, end] -= 1
    count = 0
    for x in range(nx):
        for y in range(ny):
            if not is_touched[x, y]:
                continue
            holds, row = 0, (x * ny + y) * nz
            for z in range(nz):
                holds += changes[x, y, z]
                out[count] = row + z
                count += holds > 0
    return count
