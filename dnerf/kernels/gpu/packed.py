# mypy: disallow_untyped_defs=False, disallow_incomplete_defs=False
"""Triton versions of `packed_weights` and `packed_sum` and their gradients: one program per ray."""

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 128
SUM_BLOCK = 32


def weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    out = torch.empty_like(optical_depth, memory_format=torch.contiguous_format)
    if len(offsets) > 1 and len(optical_depth):
        tensors = optical_depth.contiguous(), offsets.contiguous(), out
        # Terms of the series for 1 - exp(-x) that reach the dtype's precision at x = 1/2.
        terms = 17 if optical_depth.dtype == torch.float64 else 9
        _weights[(len(offsets) - 1,)](*tensors, terms, BLOCK, num_warps=2)
    return out


def grad_optical_depth(grad: Tensor, optical_depth: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    out = torch.empty_like(optical_depth, memory_format=torch.contiguous_format)
    if len(offsets) > 1 and len(optical_depth):
        tensors = grad.contiguous(), optical_depth.contiguous(), weights, offsets.contiguous(), out
        _grad_optical_depth[(len(offsets) - 1,)](*tensors, BLOCK, num_warps=2)
    return out


def sums(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    num_rays, num_columns = len(offsets) - 1, values.shape[1]
    out = values.new_zeros((num_rays, num_columns))
    if num_rays and values.numel():
        width = min(triton.next_power_of_2(num_columns), 64)
        tensors = values.contiguous(), values if weights is None else weights.contiguous(), offsets.contiguous(), out
        _sums[num_rays, triton.cdiv(num_columns, width)](*tensors, num_columns, weights is not None, SUM_BLOCK, width)
    return out


def grad_values(grad: Tensor, weights: Tensor | None, offsets: Tensor, num_samples: int) -> Tensor:
    per_sample = torch.repeat_interleave(grad, offsets.diff(), 0, output_size=num_samples)
    return per_sample if weights is None else per_sample.mul_(weights[:, None])


def grad_weights(grad: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    return (torch.repeat_interleave(grad, offsets.diff(), 0, output_size=len(values)) * values).sum(1)


@triton.jit
def _weights(optical_depth, offsets, out, terms: tl.constexpr, block: tl.constexpr):
    ray = tl.program_id(0)
    first, last = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    carry = tl.zeros((), out.dtype.element_ty)
    start = first
    while start < last:
        i = start + tl.arange(0, block)
        tau = tl.load(optical_depth + i, i < last, 0.0)
        # Shifted rather than inclusive minus self, which is inf - inf on an opaque sample.
        previous = tl.load(optical_depth + i - 1, (i > first) & (i < last), 0.0)
        before = carry + tl.cumsum(previous, 0)
        series = tl.full((block,), 1.0, tau.dtype)
        for n in tl.static_range(terms - 1):
            series = 1 - tl.minimum(tau, 0.5) / (terms - n) * series
        opacity = tl.where(tau < 0.5, tau * series, 1 - tl.exp(-tau))
        tl.store(out + i, tl.exp(-before) * opacity, i < last)
        carry += tl.sum(previous, 0)
        start += block


@triton.jit
def _grad_optical_depth(grad, optical_depth, weights, offsets, out, block: tl.constexpr):
    """dL/dtau_j = g_j exp(-sum_{i<=j} tau_i) - sum_{i>j} g_i w_i."""
    ray = tl.program_id(0)
    first, last = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    carry = tl.zeros((), out.dtype.element_ty)
    start = first
    while start < last:
        i = start + tl.arange(0, block)
        tau = tl.load(optical_depth + i, i < last, 0.0)
        gradient = tl.load(grad + i, i < last, 0.0)
        tl.store(out + i, gradient * tl.exp(-(carry + tl.cumsum(tau, 0))), i < last)
        carry += tl.sum(tau, 0)
        start += block
    # The same lane meets the same samples on the way back, so that it reads what it wrote itself.
    behind = tl.zeros((), out.dtype.element_ty)
    while start > first:
        start -= block
        i = start + tl.arange(0, block)
        following = tl.load(grad + i + 1, i + 1 < last, 0.0) * tl.load(weights + i + 1, i + 1 < last, 0.0)
        total = behind + tl.cumsum(following, 0, reverse=True)
        tl.store(out + i, tl.load(out + i, i < last, 0.0) - total, i < last)
        behind += tl.sum(following, 0)


@triton.jit
def _sums(values, weights, offsets, out, num_columns, weighted: tl.constexpr, block: tl.constexpr, width: tl.constexpr):
    ray = tl.program_id(0)
    columns = tl.program_id(1) * width + tl.arange(0, width)
    start, last = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    total = tl.zeros((width,), out.dtype.element_ty)
    while start < last:
        i = start + tl.arange(0, block)
        mask = (i < last)[:, None] & (columns < num_columns)[None, :]
        tile = tl.load(values + i[:, None] * num_columns + columns[None, :], mask, 0.0)
        if weighted:
            tile *= tl.load(weights + i, i < last, 0.0)[:, None]
        total += tl.sum(tile, 0)
        start += block
    tl.store(out + ray.to(tl.int64) * num_columns + columns, total, columns < num_columns)
