"""Volume-rendering weights of packed samples."""

from typing import Any

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .op import op


def packed_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Weights `w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i))`, the sum over earlier samples of the same ray.

    Accumulated ray by ray: one cumulative sum over all rays minus each ray's start loses all precision. An infinite
    optical depth is an opaque sample; value and gradient stay finite.

    Args:
        optical_depth: (N,), >= 0, no unit, differentiable.
        offsets: (R + 1,) int64 non-decreasing, from 0 to N; ray r owns samples `offsets[r] : offsets[r + 1]`.

    Returns:
        (N,) weights in [0, 1], in the dtype of `optical_depth` and at least float32.

    Raises:
        ValueError: a shape that does not fit, or (on the CPU) offsets that do not run from 0 to N.

    The compiled versions are differentiable once; second derivatives need `use_backend("reference")`.
    """
    if optical_depth.ndim != 1:
        raise ValueError(f"optical_depth must have shape (N,), got {tuple(optical_depth.shape)}")
    check_offsets(offsets)
    if optical_depth.dtype != torch.float32:
        optical_depth = optical_depth.to(torch.promote_types(optical_depth.dtype, torch.float32))
    if choose(optical_depth) == "reference":
        return packed_weights_reference(optical_depth, offsets)
    return torch.ops.dnerf.packed_weights(optical_depth, offsets)


def packed_weights_reference(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """The definition of `packed_weights` in plain torch, on rays padded to the same number of samples."""
    if not len(optical_depth):
        return optical_depth.clone()
    counts = offsets.diff()
    rays = torch.repeat_interleave(counts)
    columns = torch.arange(len(optical_depth), device=offsets.device) - offsets[rays]
    padded = optical_depth.new_zeros(len(counts), int(counts.max())).index_put((rays, columns), optical_depth)
    # Shifted rather than inclusive minus self, which is inf - inf on an opaque sample.
    before = torch.cat((torch.zeros_like(padded[:, :1]), padded.cumsum(-1)[:, :-1]), -1)
    return (torch.exp(-before) * -torch.expm1(-padded))[rays, columns]


def check_offsets(offsets: Tensor) -> None:
    """Raise ValueError unless the offsets can be those of packed samples, as far as shape and dtype say."""
    if offsets.ndim != 1 or offsets.shape[0] < 1 or offsets.dtype != torch.int64:
        raise ValueError(f"offsets must be int64 of shape (R + 1,), got {offsets.dtype} {tuple(offsets.shape)}")


@op("dnerf::packed_weights")
def _packed_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    return run_compiled("packed", "weights", optical_depth, offsets)


@op("dnerf::packed_weights_grad")
def _packed_weights_grad(grad: Tensor, optical_depth: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    return run_compiled("packed", "grad_optical_depth", grad, optical_depth, weights, offsets)


@_packed_weights.register_fake
def _(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    return torch.empty_like(optical_depth, memory_format=torch.contiguous_format)


@_packed_weights_grad.register_fake
def _(grad: Tensor, optical_depth: Tensor, weights: Tensor, offsets: Tensor) -> Tensor:
    return torch.empty_like(optical_depth, memory_format=torch.contiguous_format)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(inputs[0], output, inputs[1])


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
    return torch.ops.dnerf.packed_weights_grad(grad, *ctx.saved_tensors), None


_packed_weights.register_autograd(_backward, setup_context=_save)
