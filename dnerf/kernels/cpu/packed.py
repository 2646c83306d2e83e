"""numba versions of `packed_weights` and `packed_sum` and their gradients.

Running sums are float64 whatever the dtype: a thousand float32 additions in a row already lose 1e-6.
"""

import math
from typing import Any

import torch
from numba import prange
from torch import Tensor

from .launch import BORROWS, FAST, array, kernel, launch, offsets_array


def weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    out = torch.empty_like(optical_depth, memory_format=torch.contiguous_format)
    launch(_log_transmittance, array(optical_depth), offsets_array(offsets, len(optical_depth)), out.numpy())
    # The exponentials are torch's, many at a time: 3 times as quick as one by one in the loop.
    return out.exp_().mul_(torch.neg(optical_depth).expm1_().neg_())


def grad_optical_depth(grad: Tensor, optical_depth: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    out = torch.empty_like(optical_depth, memory_format=torch.contiguous_format)
    arrays = array(grad), array(optical_depth), array(weights)
    launch(_grad_optical_depth, *arrays, offsets_array(offsets, len(optical_depth)), out.numpy())
    return out


def sums(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    out = values.new_empty((len(offsets) - 1, values.shape[1]))
    weights_ = None if weights is None else array(weights)
    launch(_sums, array(values), weights_, offsets_array(offsets, len(values)), out.numpy())
    return out


def grad_values(grad: Tensor, weights: Tensor | None, offsets: Tensor, num_samples: int) -> Tensor:
    out = grad.new_empty((num_samples, grad.shape[1]))
    weights_ = None if weights is None else array(weights)
    launch(_grad_values, array(grad), weights_, offsets_array(offsets, num_samples), out.numpy())
    return out


def grad_weights(grad: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    out = grad.new_empty(len(values))
    launch(_grad_weights, array(grad), array(values), offsets_array(offsets, len(values)), out.numpy())
    return out


@kernel(fastmath=FAST, **BORROWS)
def _log_transmittance(optical_depth: Any, offsets: Any, out: Any) -> None:
    for r in prange(len(offsets) - 1):
        before = 0.0
        for i in range(offsets[r], offsets[r + 1]):
            out[i] = -before
            before += optical_depth[i]


@kernel(fastmath=FAST, **BORROWS)
def _grad_optical_depth(grad: Any, optical_depth: Any, weights: Any, offsets: Any, out: Any) -> None:
    """dL/dtau_j = g_j exp(-sum_{i<=j} tau_i) - sum_{i>j} g_i w_i."""
    dtype = optical_depth.dtype.type
    for r in prange(len(offsets) - 1):
        through = 0.0
        for i in range(offsets[r], offsets[r + 1]):
            through += optical_depth[i]
            out[i] = grad[i] * math.exp(-dtype(through))
        behind = 0.0
        for i in range(offsets[r + 1] - 1, offsets[r] - 1, -1):
            out[i] -= behind
            behind += grad[i] * weights[i]


@kernel(fastmath=FAST, **BORROWS)
def _sums(values: Any, weights: Any, offsets: Any, out: Any) -> None:
    for r in prange(len(offsets) - 1):
        for c in range(values.shape[1]):
            total = 0.0
            for i in range(offsets[r], offsets[r + 1]):
                total += values[i, c] if weights is None else weights[i] * values[i, c]
            out[r, c] = total


@kernel(fastmath=FAST, **BORROWS)
def _grad_values(grad: Any, weights: Any, offsets: Any, out: Any) -> None:
    for r in prange(len(offsets) - 1):
        for i in range(offsets[r], offsets[r + 1]):
            for c in range(grad.shape[1]):
                out[i, c] = grad[r, c] if weights is None else weights[i] * grad[r, c]


@kernel(fastmath=FAST, **BORROWS)
def _grad_weights(grad: Any, values: Any, offsets: Any, out: Any) -> None:
    for r in prange(len(offsets) - 1):
        for i in range(offsets[r], offsets[r + 1]):
            total = values.dtype.type(0)
            for c in range(values.shape[1]):
                total += grad[r, c] * values[i, c]
            out[i] = total
