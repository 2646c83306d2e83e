# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `add_seen`."""

from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .launch import BORROWS, kernel, launch, num_threads
from .seen_weights import RAYS_AT_ONCE, weigh, weight_tables
from .tasks import next_task, none_taken

HALF = np.float32(0.5)


def add_seen(
    sums: Tensor,
    rays: Tensor,
    light: Tensor,
    starts: Tensor,
    ends: Tensor,
    offsets: Tensor,
    density: Tensor,
    rgb: Tensor,
    distances: Tensor | None,
) -> Tensor:
    if offsets[0] != 0 or offsets[-1] != len(starts):
        raise ValueError(f"offsets must run from 0 to {len(starts)}, got {int(offsets[0])} to {int(offsets[-1])}")
    if len(rays):
        first, last = (int(x) for x in rays.aminmax())
        if first < 0 or last >= len(sums):
            raise ValueError(f"rays must lie in [0, {len(sums)}), got {first} to {last}")
    passing = light.new_empty(len(rays))
    arrays = (x.detach().contiguous().numpy() for x in (rays, light, starts, ends, offsets, density, rgb))
    points = None if distances is None else distances.detach().contiguous().numpy()
    weights = weight_tables(len(starts))
    launch(_add_seen, sums.numpy(), *arrays, points, passing.numpy(), weights, num_threads(), none_taken())
    return passing


# No fast-math: NaN densities are seen.
@kernel(**BORROWS)
def _add_seen(
    sums: Any,
    rays: Any,
    light: Any,
    starts: Any,
    ends: Any,
    offsets: Any,
    density: Any,
    rgb: Any,
    distances: Any,
    passing: Any,
    weights: Any,
    num_workers: int,
    taken: Any,
) -> None:
    for _ in prange(num_workers):
        first = next_task(taken) * RAYS_AT_ONCE
        while first < len(rays):
            last = min(first + RAYS_AT_ONCE, len(rays))
            weigh(starts, ends, offsets, density, first, last, weights[0], weights[1])
            for r in range(first, last):
                red, green, blue, far, opacity = 0.0, 0.0, 0.0, 0.0, 0.0
                for i in range(offsets[r], offsets[r + 1]):
                    weight = weights[0, i]
                    red += weight * rgb[i, 0]
                    green += weight * rgb[i, 1]
                    blue += weight * rgb[i, 2]
                    far += weight * (HALF * (starts[i] + ends[i]) if distances is None else distances[i])
                    opacity += weight
                opacity = 1.0 if opacity > 1 else opacity
                passing[r] = 1 - opacity
                row = rays[r]
                for k, total in enumerate((red, green, blue, far, opacity)):
                    sums[row, k] += light[r] * np.float32(total)
            first = next_task(taken) * RAYS_AT_ONCE
