"""Volume-rendering weights of packed samples."""

from typing import Any

import torch
from torch import Tensor

from dnerf.core.rays import parts_of

from .backend import choose
from .checks import check_offsets, check_shape
from .op import op

MOST_DENSITY = 1e30  # as `dnerf.core.quadrature.OPAQUE`: infinite density on an interval of no length adds nothing


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
    check_shape("optical_depth", optical_depth, ("N",))
    check_offsets(offsets)
    if optical_depth.dtype != torch.float32:
        optical_depth = optical_depth.to(torch.promote_types(optical_depth.dtype, torch.float32))
    if choose(optical_depth) == "reference":
        return packed_weights_reference(optical_depth, offsets)
    return _packed_weights(optical_depth, offsets)


def packed_weights_reference(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """The definition of `packed_weights` in plain torch, on rays padded to the same number of samples."""
    if not len(optical_depth):
        return optical_depth.clone()
    counts = offsets.diff()
    rays, columns = parts_of(counts)
    padded = optical_depth.new_zeros(len(counts), int(counts.max())).index_put((rays, columns), optical_depth)
    # Shifted rather than inclusive minus self, which is inf - inf on an opaque sample.
    before = torch.cat((torch.zeros_like(padded[:, :1]), padded.cumsum(-1)[:, :-1]), -1)
    return (torch.exp(-before) * -torch.expm1(-padded))[rays, columns]


_packed_weights_grad = op(
    "packed_weights_grad(Tensor grad, Tensor optical_depth, Tensor weights, Tensor offsets) -> Tensor",
    "packed.grad_optical_depth", gradient_of="packed_weights",
)  # fmt: skip


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(inputs[0], output, inputs[1])


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
    return _packed_weights_grad(grad, *ctx.saved_tensors), None


_packed_weights = op(
    "packed_weights(Tensor optical_depth, Tensor offsets) -> Tensor", "packed.weights", backward=_backward,
    setup_context=_save,
)  # fmt: skip
