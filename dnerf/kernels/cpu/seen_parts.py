# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `seen_parts`."""

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from .exponential import exp, expm1
from .launch import BORROWS, kernel, launch

LEFT_OUT, WHOLE, CUT = 0, 1, 2
OPAQUE = 87.0  # optical depth, behind which there is no light in single precision
NOTHING = np.float32(0)


def seen_parts(
    starts: Tensor,
    ends: Tensor,
    offsets: Tensor,
    density: Tensor,
    light: Tensor,
    splits: int,
    split_weight: float,
    min_weight: float,
) -> tuple[Tensor, ...]:
    arrays = [x.detach().contiguous().numpy() for x in (starts, ends, offsets, density, light)]
    if arrays[2][0] != 0 or arrays[2][-1] != len(starts):
        raise ValueError(f"offsets must run from 0 to {len(starts)}, got {arrays[2][0]} to {arrays[2][-1]}")
    kinds = torch.empty(len(starts), dtype=torch.uint8)
    ranges = torch.zeros(2, len(offsets), dtype=torch.int64)  # of each ray's parts, and of those that are new
    options = splits, np.float32(split_weight), np.float32(min_weight)
    launch(_choose, *arrays, options, kinds.numpy(), ranges.numpy())
    ranges = ranges.cumsum(1)
    size, num_new = (int(x) for x in ranges[:, -1])
    parts = starts.new_empty(2, size)
    indices = ranges.new_empty(2, size)
    new = ranges.new_empty(num_new)
    launch(_fill, *arrays[:3], splits, kinds.numpy(), ranges.numpy(), parts.numpy(), indices.numpy(), new.numpy())
    return parts[0], parts[1], indices[0], ranges[0], indices[1], new


# No fast-math: NaN weights are seen. Weights are of single precision, whatever lengths are.
@kernel(**BORROWS)
def _choose(
    starts: Any, ends: Any, offsets: Any, density: Any, light: Any, options: Any, kinds: Any, ranges: Any
) -> None:
    """What becomes of every interval, and how many parts each ray gets."""
    splits, split_weight, min_weight = options
    for r in prange(len(light)):
        behind, size, num_new = 0.0, 0, 0
        for i in range(offsets[r], offsets[r + 1]):
            depth = density[i] * (ends[i] - starts[i])
            before = NOTHING if behind > OPAQUE else exp(-np.float32(behind))
            weight = before * -expm1(-np.float32(depth)) * np.float32(light[r])
            behind += depth
            if weight <= min_weight:
                kinds[i] = LEFT_OUT
            elif weight <= split_weight or splits == 1:
                kinds[i] = WHOLE
                size += 1
            else:
                kinds[i] = CUT
                size += splits
                num_new += splits - splits % 2
        ranges[0, r + 1], ranges[1, r + 1] = size, num_new


@kernel(**BORROWS)
def _fill(
    starts: Any, ends: Any, offsets: Any, splits: int, kinds: Any, ranges: Any, parts: Any, indices: Any, new: Any
) -> None:
    of_type = starts.dtype.type
    for r in prange(len(offsets) - 1):
        place, new_place = ranges[0, r], ranges[1, r]
        for i in range(offsets[r], offsets[r + 1]):
            count = splits if kinds[i] == CUT else int(kinds[i])
            for k in range(count):
                parts[0, place] = _between(starts[i], ends[i], of_type(k) / of_type(count))
                parts[1, place] = _between(starts[i], ends[i], of_type(k + 1) / of_type(count))
                indices[0, place], indices[1, place] = r, i
                if 2 * k + 1 != count:
                    new[new_place] = place
                    new_place += 1
                place += 1


@njit(forceinline=True, **BORROWS)
def _between(start: Any, end: Any, share: Any) -> Any:
    """As `torch.lerp`, exact at both ends."""
    if share < type(share)(0.5):
        return start + share * (end - start)
    return end - (end - start) * (type(share)(1) - share)
