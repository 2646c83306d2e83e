# mypy: disable-error-code="call-arg"
"""Weights of packed samples in single precision, for use inside numba kernels that deal out rays."""

from typing import Any

import numpy as np
from numba import njit

from ..packed_weights import MOST_DENSITY
from .exponential import exp, expm1
from .launch import BORROWS

RAYS_AT_ONCE = 64  # dealt out to threads
OPAQUE = np.float32(87)  # optical depth, behind which there is no light in single precision
NOTHING, MOST = np.float32(0), np.float32(MOST_DENSITY)


# No fast-math: NaN densities are seen.
@njit(**BORROWS)
def weigh(starts: Any, ends: Any, offsets: Any, density: Any, first: int, last: int, weights: Any, before: Any) -> None:
    """Weights (N,) of the samples of rays `first` to `last`, and optical depths before them (N,)."""
    for r in range(first, last):
        total = 0.0
        for i in range(offsets[r], offsets[r + 1]):
            dense = MOST if density[i] > MOST else density[i]
            depth = dense * (ends[i] - starts[i])
            weights[i], before[i] = depth, total
            total += depth
    # Slices, counted from 0: where an index might be negative no vector instructions are used.
    depths, befores = weights[offsets[first] : offsets[last]], before[offsets[first] : offsets[last]]
    for i in range(len(depths)):
        light = NOTHING if befores[i] > OPAQUE else exp(-befores[i])
        depths[i] = light * -expm1(-depths[i])
