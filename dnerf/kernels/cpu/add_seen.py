# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `add_seen`."""

from typing import Any

import numpy as np
from numba import prange
from torch import Tensor

from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads, offsets_array, rows_array
from .seen_weights import RAYS_AT_ONCE, weigh

HALF = np.float32(0.5)


def add_seen(
    sums: Tensor, rays: Tensor, light: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor,
    rgb: Tensor, distances: Tensor | None,
) -> Tensor:  # fmt: skip
    passing = light.new_empty(len(rays))
    rows, bounds = rows_array("rays", rays, len(sums)), offsets_array(offsets, len(starts))
    light_, starts_, ends_, density_, rgb_ = (array(x) for x in (light, starts, ends, density, rgb))
    points = None if distances is None else array(distances)
    launch(
        _add_seen, sums.numpy(), rows, light_, starts_, ends_, bounds, density_, rgb_, points, passing.numpy(),
        np.empty((2, len(starts)), np.float32), num_threads(), none_taken(),
    )  # fmt: skip
    return passing


# No fast-math: NaN densities are seen.
@kernel(**BORROWS)
def _add_seen(
    sums: Any, rays: Any, light: Any, starts: Any, ends: Any, offsets: Any, density: Any, rgb: Any, distances: Any,
    passing: Any, weights: Any, num_workers: int, taken: Any,
) -> None:  # fmt: skip
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
