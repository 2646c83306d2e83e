"""Sums of packed samples along each ray."""

from typing import Any

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .op import op
from .packed_weights import check_offsets


def packed_sum(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    """Sum over each ray's samples of `weights_i values_i`, or of `values_i` alone. A ray without samples gives zero.

    Args:
        values: (N, C) or (N,), differentiable.
        weights: (N,), differentiable, or None for ones.
        offsets: (R + 1,) int64 non-decreasing, from 0 to N; ray r owns samples `offsets[r] : offsets[r + 1]`.

    Returns:
        (R, C) or (R,), in the wider dtype of the arguments and at least float32.

    Raises:
        ValueError: a shape that does not fit, or (on the CPU) offsets that do not run from 0 to N.

    The compiled versions are differentiable once; second derivatives need `use_backend("reference")`.
    """
    if values.ndim not in (1, 2):
        raise ValueError(f"values must have shape (N, C) or (N,), got {tuple(values.shape)}")
    if weights is not None and weights.shape != values.shape[:1]:
        raise ValueError(f"weights must have shape ({values.shape[0]},), got {tuple(weights.shape)}")
    check_offsets(offsets)
    dtype = torch.promote_types(values.dtype, torch.float32)
    if weights is not None:
        dtype = torch.promote_types(dtype, weights.dtype)
        weights = weights.to(dtype)
    columns = values.to(dtype) if values.ndim == 2 else values.to(dtype)[:, None]
    if choose(columns) == "reference":
        sums = packed_sum_reference(columns, weights, offsets)
    else:
        sums = torch.ops.dnerf.packed_sum(columns, weights, offsets)
    return sums if values.ndim == 2 else sums[:, 0]


def packed_sum_reference(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    """The definition of `packed_sum` in plain torch, for values of shape (N, C)."""
    rays = torch.repeat_interleave(offsets.diff())
    weighted = values if weights is None else values * weights[:, None]
    # A thousand float32 additions in a row already lose 1e-6.
    sums = values.new_zeros(len(offsets) - 1, values.shape[1], dtype=torch.float64)
    return sums.index_add(0, rays, weighted.double()).to(weighted.dtype)


@op("dnerf::packed_sum")
def _packed_sum(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    return run_compiled("packed", "sums", values, weights, offsets)


@op("dnerf::packed_sum_grad_values")
def _grad_values(grad: Tensor, weights: Tensor | None, offsets: Tensor, num_samples: int) -> Tensor:
    return run_compiled("packed", "grad_values", grad, weights, offsets, num_samples)


@op("dnerf::packed_sum_grad_weights")
def _grad_weights(grad: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    return run_compiled("packed", "grad_weights", grad, values, offsets)


@_packed_sum.register_fake
def _(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    return values.new_empty((offsets.shape[0] - 1, values.shape[1]))


@_grad_values.register_fake
def _(grad: Tensor, weights: Tensor | None, offsets: Tensor, num_samples: int) -> Tensor:
    return grad.new_empty((num_samples, grad.shape[1]))


@_grad_weights.register_fake
def _(grad: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    return grad.new_empty(values.shape[:1])


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    values, weights, offsets = inputs
    ctx.num_samples = values.shape[0]
    # The values are needed for the gradient to the weights alone.
    ctx.save_for_backward(values if weights is not None and weights.requires_grad else None, weights, offsets)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
    values, weights, offsets = ctx.saved_tensors
    needs_values, needs_weights = ctx.needs_input_grad[:2]
    ops = torch.ops.dnerf
    return (
        ops.packed_sum_grad_values(grad, weights, offsets, ctx.num_samples) if needs_values else None,
        ops.packed_sum_grad_weights(grad, values, offsets) if needs_weights else None,
        None,
    )


_packed_sum.register_autograd(_backward, setup_context=_save)
