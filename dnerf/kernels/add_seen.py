"""Composite packed samples of some rays into what they have shown so far."""

import torch
from torch import Tensor

from dnerf.core.checks import check_shape

from .backend import choose, run_compiled
from .checks import check_shapes
from .packed_sum import packed_sum
from .packed_weights import MOST_DENSITY, packed_weights


@torch.no_grad()
def add_seen(
    sums: Tensor, rays: Tensor, light: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor,
    rgb: Tensor, distances: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Add what rays show of further samples to `sums`, and say how much light passes these.

    Not differentiable: for images, of which a ray's samples come in rounds; `dnerf.core.compositing.composite` is for
    all else.

    Args:
        sums: (T, 5) red, green, blue, distance times opacity, and opacity; changed in place.
        rays: (R,) int64, rows of `sums`, all different.
        light: (R,) transmittance before each ray's first sample.
        starts, ends: (N,) distances along the rays, ray by ray and in order.
        offsets: (R + 1,) int64, where each ray's samples begin and end.
        density: (N,) in 1 / unit of the distances, >= 0.
        rgb: (N, 3).
        distances: (N,) that count as the samples' own; the middle of each if None.

    Returns:
        (R,) transmittance of the samples alone; NaN where a density is.

    Raises:
        ValueError: shapes that do not fit each other, or (by the compiled version) offsets that do not run from 0 to N,
            or rays that are no rows.
    """
    count, num_rays = len(starts), len(rays)
    check_shapes(sums=(sums, (len(sums), 5)), light=(light, (num_rays,)), offsets=(offsets, (num_rays + 1,)))
    check_shapes(ends=(ends, (count,)), density=(density, (count,)), rgb=(rgb, (count, 3)))
    if distances is not None:
        check_shape("distances", distances, (count,))
    arguments = (sums, rays, light, starts, ends, offsets, density, rgb, distances)
    is_single = all(x is None or x.dtype in (torch.float32, torch.int64) for x in arguments)
    if is_single and sums.is_contiguous() and choose(sums) == "numba":
        return run_compiled("add_seen", "add_seen", *arguments)
    return add_seen_reference(*arguments)


def add_seen_reference(
    sums: Tensor, rays: Tensor, light: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor,
    rgb: Tensor, distances: Tensor | None,
) -> Tensor:  # fmt: skip
    """The definition of `add_seen` in plain torch, but for what has kernels of its own."""
    distances = 0.5 * (starts + ends) if distances is None else distances
    columns = torch.cat([rgb, distances[:, None], torch.ones_like(distances)[:, None]], dim=-1)
    seen = packed_sum(columns, packed_weights(density.clamp(max=MOST_DENSITY) * (ends - starts), offsets), offsets)
    seen[:, 4].clamp_(max=1)
    sums.index_add_(0, rays, (light[:, None] * seen).to(sums.dtype))
    return 1 - seen[:, 4]
