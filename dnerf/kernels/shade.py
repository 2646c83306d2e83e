"""Density and colour of a network's last products."""

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .checks import check_shapes

MOST_LOG_DENSITY = 15.0  # as `dnerf.fields.activations.truncated_exp`


@torch.no_grad()
def shade(raw: Tensor, bias: Tensor, log_shift: float) -> tuple[Tensor, Tensor]:
    """exp(min(r_0 + b_0 + log_shift, 15)), and sigmoid(r_k + b_k) of the other three. Not differentiable: for images.

    Args:
        raw: (N, 4) products, of density, red, green and blue.
        bias: (4,).
        log_shift: added before the exponential.

    Returns:
        Densities (N,) and colours (N, 3), float32, or float64 of float64.

    Raises:
        ValueError: a shape that does not fit.
    """
    check_shapes(raw=(raw, ("N", 4)), bias=(bias, (4,)))
    dtype = torch.promote_types(raw.dtype, torch.float32)
    bias = bias.to(dtype)
    if raw.dtype in (torch.bfloat16, torch.float32) and choose(bias) == "numba":
        return run_compiled("shade", "shade", raw, bias, log_shift)
    return shade_reference(raw.to(dtype), bias, log_shift)


def shade_reference(raw: Tensor, bias: Tensor, log_shift: float) -> tuple[Tensor, Tensor]:
    """The definition of `shade` in plain torch."""
    values = raw + bias
    return torch.exp((values[:, 0] + log_shift).clamp(max=MOST_LOG_DENSITY)), torch.sigmoid(values[:, 1:])
