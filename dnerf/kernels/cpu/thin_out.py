"""numba version of `thin_out`."""

import math
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ..thin_out import STRAIGHT
from .launch import BORROWS, array, kernel


def thin_out(points: Tensor, times: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    chosen, before = torch.empty(len(points), dtype=torch.int64), torch.empty(len(points), dtype=torch.int64)
    fractions = torch.zeros_like(times, dtype=points.dtype, memory_format=torch.contiguous_format)
    count = _thin_out(array(points), array(times), spacing, chosen.numpy(), before.numpy(), fractions.numpy())
    return chosen[:count], before, fractions


# One thread: starting a second one takes as long as half of this.
@kernel(parallel=False, **BORROWS)
def _thin_out(points: Any, times: Any, spacing: float, chosen: Any, before: Any, fractions: Any) -> int:
    """How many points were chosen; the arrays are filled."""
    num_points, count = len(points), 0
    was_near, first, part = False, 0, 0.0
    x, y, z, length = 0.0, 0.0, 0.0, 0.0  # of the last step
    for i in range(num_points):
        follows, is_near = False, False
        if i > 0:
            u, v, w = _step(points, i - 1, i)
            far = math.sqrt(u * u + v * v + w * w)
            is_near = times[i] == times[i - 1] and far <= spacing
            follows = is_near and not (was_near and u * x + v * y + w * z < STRAIGHT * far * length)
            x, y, z, length = u, v, w, far
        was_near = is_near
        if not follows:
            if i > 0 and (count == 0 or chosen[count - 1] != i - 1):  # the last one of its row
                count = _choose(i - 1, count, points, chosen, before, fractions)
            first = i
        u, v, w = _step(points, first, i)
        number = math.floor(math.sqrt(u * u + v * v + w * w) / spacing) if follows else 0.0
        if not follows or number != part:
            count = _choose(i, count, points, chosen, before, fractions)
        part = number
    if num_points and chosen[count - 1] != num_points - 1:
        count = _choose(num_points - 1, count, points, chosen, before, fractions)
    return count


@njit(**BORROWS)
def _step(points: Any, i: int, j: int) -> Any:
    """From one point to another."""
    a, b = points[i], points[j]
    return np.float64(b[0]) - np.float64(a[0]), np.float64(b[1]) - np.float64(a[1]), np.float64(b[2]) - np.float64(a[2])


@njit(**BORROWS)
def _choose(i: int, count: int, points: Any, chosen: Any, before: Any, fractions: Any) -> int:
    """Choose a point, and place those between it and the one chosen before."""
    if count:
        start = chosen[count - 1]
        u, v, w = _step(points, start, i)
        way = math.sqrt(u * u + v * v + w * w)
        for k in range(start + 1, i):
            u, v, w = _step(points, start, k)
            before[k] = count - 1
            fractions[k] = math.sqrt(u * u + v * v + w * w) / way if way > 0 else 0.0
    chosen[count], before[i] = i, count
    return count + 1
