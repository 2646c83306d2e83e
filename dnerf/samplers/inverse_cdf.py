"""Inverse-CDF sampling of a piecewise-constant density."""

import torch
from torch import Tensor

from dnerf.core.checks import check_positive, check_shape


def sample_piecewise_constant(
    edges: Tensor, weights: Tensor, num_samples: int, *, randomized: bool = False,
    generator: torch.Generator | None = None,
) -> Tensor:  # fmt: skip
    """Draw sorted positions from histograms whose bins hold `weights`.

    A total below 1e-5 is filled up evenly, so that a histogram of zeros is sampled uniformly and no division is 0/0;
    others are sampled exactly. Within a bin positions are uniform. No gradient flows.

    Args:
        edges: (R, S + 1) sorted bin edges.
        weights: (R, S) >= 0.
        num_samples: positions per row.
        randomized: one uniform number in each of `num_samples` strata of the CDF; their middles otherwise.
        generator: source of randomness.

    Returns:
        (R, num_samples) sorted positions in [edges[:, 0], edges[:, -1]].

    Raises:
        ValueError: if shapes do not fit.
    """
    check_positive("num_samples", num_samples)
    check_shape("weights", weights, ("R", "S"))
    num_rays, num_bins = weights.shape
    check_shape("edges", edges, (num_rays, num_bins + 1))
    weights, edges = weights.detach(), edges.detach()
    missing = (1e-5 - weights.sum(-1, keepdim=True)).clamp(min=0)
    weights = weights + missing / num_bins
    cdf = torch.cumsum(weights, dim=-1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf / cdf[:, -1:]], dim=-1).contiguous()
    strata = torch.arange(num_samples, dtype=cdf.dtype, device=cdf.device).expand(num_rays, num_samples)
    within = torch.full_like(cdf[:, :1], 0.5)
    if randomized:
        within = torch.rand(strata.shape, generator=generator, dtype=cdf.dtype, device=cdf.device)
    # Rounding may take the last stratum to 1, which lies behind every bin, empty last ones included.
    u = ((strata + within) / num_samples).clamp(max=1 - torch.finfo(cdf.dtype).eps / 2).contiguous()
    upper = torch.searchsorted(cdf, u, right=True).clamp(1, num_bins)
    low, high = cdf.gather(-1, upper - 1), cdf.gather(-1, upper)
    width = high - low
    fraction = torch.where(width > 0, (u - low) / torch.where(width > 0, width, 1.0), 0.5).clamp(0, 1)
    return torch.lerp(edges.gather(-1, upper - 1), edges.gather(-1, upper), fraction)
