# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `footprints`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ..footprints import Footprints
from .launch import BORROWS, array, kernel


def footprints(
    pose: Tensor, places: Tensor, faces: Sequence[Tensor], lens: Sequence[float], size: tuple[int, int]
) -> Footprints | None:
    pixels, depths = torch.empty(size[0] * size[1], dtype=torch.int64), pose.new_empty(2, *size)
    packed = torch.empty_like(depths).view(2, -1)
    real = array(pose)
    count = _footprints(
        real, places.numpy(), tuple(face.numpy() for face in faces), np.asarray(lens, real.dtype), depths.numpy(),
        np.zeros(size[0], np.bool_), pixels.numpy(), packed.numpy(),
    )  # fmt: skip
    return None if count < 0 else Footprints(pixels[:count], packed[:, :count])


# One thread: starting a second one takes as long as half of this. No fast-math: it rounds like the definition.
@kernel(parallel=False, **BORROWS)
def _footprints(
    pose: Any, places: Any, faces: Any, lens: Any, depths: Any, is_touched: Any, pixels: Any, packed: Any
) -> int:
    """Note the depths of each cell in its rectangle, then walk along the rows that some rectangle meets."""
    height, width = depths.shape[1:]
    deep, wide = len(faces[2]) - 1, len(faces[1]) - 1
    nearest, farthest = depths
    infinity = type(pose[0, 0])(math.inf)
    for place in places:
        cell = place // (deep * wide), place // deep % wide, place % deep
        ok, (left, right), (top, bottom), (near, far) = _span(pose, faces, cell, lens)
        if not ok:
            return -1
        begin, end = _range(left, right, width)
        first, last = _range(top, bottom, height)
        if begin >= end:
            continue
        for row in range(first, last):
            if not is_touched[row]:
                is_touched[row] = True
                nearest[row] = infinity
                farthest[row] = -infinity
            for column in range(begin, end):
                least, most = nearest[row, column], farthest[row, column]
                nearest[row, column] = near if near < least else least
                farthest[row, column] = far if far > most else most
    count = 0
    for row in range(height):
        if not is_touched[row]:
            continue
        for column in range(width):
            pixels[count] = row * width + column
            packed[0, count], packed[1, count] = nearest[row, column], farthest[row, column]
            count += nearest[row, column] < infinity
    return count


@njit(forceinline=True, **BORROWS)
def _span(pose: Any, faces: Any, cell: Any, lens: Any) -> Any:
    """Whether a cell lies before the camera, and between which columns, rows and depths."""
    real = type(pose[0, 0])
    least, most = real(math.inf), real(-math.inf)
    left, right, top, bottom, near, far = least, most, least, most, least, most
    ok = True
    for i in range(2):
        a = faces[0][cell[0] + i] - pose[0, 3]
        for j in range(2):
            b = faces[1][cell[1] + j] - pose[1, 3]
            for k in range(2):
                c = faces[2][cell[2] + k] - pose[2, 3]
                x = a * pose[0, 0] + b * pose[1, 0] + c * pose[2, 0]
                y = a * pose[0, 1] + b * pose[1, 1] + c * pose[2, 1]
                depth = -(a * pose[0, 2] + b * pose[1, 2] + c * pose[2, 2])
                scale = real(1) / depth
                column, row = x * scale * lens[0] + lens[2], lens[3] - y * scale * lens[1]
                ok = ok and depth > 0 and math.isfinite(column) and math.isfinite(row)
                left, right = min(left, column), max(right, column)
                top, bottom = min(top, row), max(bottom, row)
                near, far = min(near, depth), max(far, depth)
    return ok, (left, right), (top, bottom), (near, far)


@njit(forceinline=True, **BORROWS)
def _range(low: Any, high: Any, size: int) -> tuple[int, int]:
    """First whole number of a span and the one behind it, among those below a size."""
    begin = int(min(max(math.floor(low), 0.0), float(size)))
    return begin, int(min(max(math.ceil(high), -1.0) + 1.0, float(size)))
