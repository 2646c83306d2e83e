"""Density activations, safe in value and gradient."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import softplus

from dnerf.core.checks import check_choice
from dnerf.core.compositing import at_least_float32

DENSITY_ACTIVATIONS = ("softplus", "exp")


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        result = torch.exp(x.clamp(max=15.0))
        ctx.save_for_backward(result)
        return result

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (result,) = ctx.saved_tensors
        return grad * result


def truncated_exp(x: Tensor) -> Tensor:
    """exp(min(x, 15)), by which its gradient is clamped as well: neither overflows (instant-ngp)."""
    return _TruncatedExp.apply(x)


def activate_density(raw: Tensor, activation: str, shift: float) -> Tensor:
    """Density (>= 0, float32 at least) of a network's raw output.

    Args:
        raw: (...,) network output; half precision is raised to float32 first.
        activation: "softplus" (mip-NeRF) or "exp" (truncated, instant-ngp).
        shift: added before the activation; negative for a thin start, which keeps gradients alive.

    Raises:
        ValueError: for another activation.
    """
    check_choice("activation", activation, DENSITY_ACTIVATIONS)
    raw = at_least_float32(raw) + shift
    return softplus(raw) if activation == "softplus" else truncated_exp(raw)
