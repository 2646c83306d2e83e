# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `seen_parts`."""

from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads, offsets_array
from .seen_weights import RAYS_AT_ONCE, weigh

LEFT_OUT, WHOLE, CUT = 0, 1, 2


def seen_parts(
    starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor, light: Tensor, subdivision: int,
    subdivision_weight: float, min_weight: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    bounds = offsets_array(offsets, len(starts))
    arrays = array(starts), array(ends), bounds, array(density), array(light)
    kinds = torch.empty(len(starts), dtype=torch.uint8)
    ranges = torch.zeros(2, len(offsets), dtype=torch.int64)  # of each ray's parts, and of those that are new
    options = subdivision, np.float32(subdivision_weight), np.float32(min_weight)
    workers = num_threads(), none_taken()
    launch(_choose, *arrays, options, kinds.numpy(), ranges.numpy(), np.empty((2, len(starts)), np.float32), *workers)
    ranges = ranges.cumsum(1)
    size, num_new = (int(x) for x in ranges[:, -1])
    parts, indices, new = starts.new_empty(2, size), ranges.new_empty(2, size), ranges.new_empty(num_new)
    launch(_fill, *arrays[:3], subdivision, kinds.numpy(), ranges.numpy(), parts.numpy(), indices.numpy(), new.numpy())
    return parts[0], parts[1], indices[0], ranges[0], indices[1], new


# No fast-math: NaN weights are seen. Weights are of single precision, whatever lengths are.
@kernel(**BORROWS)
def _choose(
    starts: Any, ends: Any, offsets: Any, density: Any, light: Any, options: Any, kinds: Any, ranges: Any, weights: Any,
    num_workers: int, taken: Any,
) -> None:  # fmt: skip
    """What becomes of every interval, and how many parts each ray gets."""
    subdivision, subdivision_weight, min_weight = options
    for _ in prange(num_workers):
        first = next_task(taken) * RAYS_AT_ONCE
        while first < len(light):
            last = min(first + RAYS_AT_ONCE, len(light))
            weigh(starts, ends, offsets, density, first, last, weights[0], weights[1])
            for r in range(first, last):
                size, num_new = 0, 0
                for i in range(offsets[r], offsets[r + 1]):
                    weight = weights[0, i] * np.float32(light[r])
                    if weight <= min_weight:
                        kinds[i] = LEFT_OUT
                    elif weight <= subdivision_weight or subdivision == 1:
                        kinds[i] = WHOLE
                        size += 1
                    else:
                        kinds[i] = CUT
                        size += subdivision
                        num_new += subdivision - subdivision % 2
                ranges[0, r + 1], ranges[1, r + 1] = size, num_new
            first = next_task(taken) * RAYS_AT_ONCE


@kernel(**BORROWS)
def _fill(
    starts: Any, ends: Any, offsets: Any, subdivision: int, kinds: Any, ranges: Any, parts: Any, indices: Any, new: Any
) -> None:
    of_type = starts.dtype.type
    for r in prange(len(offsets) - 1):
        place, new_place = ranges[0, r], ranges[1, r]
        for i in range(offsets[r], offsets[r + 1]):
            count = subdivision if kinds[i] == CUT else int(kinds[i])
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
