"""Sums of packed samples along each ray."""

from typing import Any

import torch
from torch import Tensor

from .backend import choose
from .checks import check_offsets, check_shape
from .op import op


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
    check_offsets(offsets)
    dtype = torch.promote_types(values.dtype, torch.float32)
    if weights is not None:
        check_shape("weights", weights, values.shape[:1])
        dtype = torch.promote_types(dtype, weights.dtype)
        weights = weights.to(dtype)
    columns = values.to(dtype) if values.ndim == 2 else values.to(dtype)[:, None]
    if choose(columns) == "reference":
        sums = packed_sum_reference(columns, weights, offsets)
    else:
        sums = _packed_sum(columns, weights, offsets)
    return sums if values.ndim == 2 else sums[:, 0]


def packed_sum_reference(values: Tensor, weights: Tensor | None, offsets: Tensor) -> Tensor:
    """The definition of `packed_sum` in plain torch, for values of shape (N, C)."""
    rays = torch.repeat_interleave(offsets.diff())
    weighted = values if weights is None else values * weights[:, None]
    # A thousand float32 additions in a row already lose 1e-6.
    sums = values.new_zeros(len(offsets) - 1, values.shape[1], dtype=torch.float64)
    return sums.index_add(0, rays, weighted.double()).to(weighted.dtype)


_grad_values = op(
    "packed_sum_grad_values(Tensor grad, Tensor? weights, Tensor offsets, int num_samples) -> Tensor",
    "packed.grad_values", gradient_of="packed_sum",
)  # fmt: skip
_grad_weights = op(
    "packed_sum_grad_weights(Tensor grad, Tensor values, Tensor offsets) -> Tensor",
    "packed.grad_weights", gradient_of="packed_sum",
)  # fmt: skip


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    values, weights, offsets = inputs
    ctx.num_samples = values.shape[0]
    # The values are needed for the gradient to the weights alone.
    ctx.save_for_backward(values if weights is not None and weights.requires_grad else None, weights, offsets)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
    values, weights, offsets = ctx.saved_tensors
    needs_values, needs_weights = ctx.needs_input_grad[:2]
    to_values = _grad_values(grad, weights, offsets, ctx.num_samples) if needs_values else None
    return to_values, _grad_weights(grad, values, offsets) if needs_weights else None, None


_packed_sum = op(
    "packed_sum(Tensor values, Tensor? weights, Tensor offsets) -> Tensor", "packed.sums", backward=_backward,
    setup_context=_save,
)  # fmt: skip
