"""Marching rays through an occupancy grid into a fixed number of places, without waiting for the device."""

import torch
from torch import Tensor

from dnerf.core.fixed_size import fit

from .backend import choose, run_compiled
from .march import MarchedSamples, checked_rays, march


@torch.no_grad()
def march_to_size(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, *, times: Tensor, jitter: Tensor, occupancy: Tensor,
    aabb: Tensor, step: Tensor, size: int,
) -> tuple[MarchedSamples, Tensor]:  # fmt: skip
    """The intervals of `march` in a fixed number of places: rays that do not fit get none, see `fixed_size.spread`.

    Places that are left are intervals of length zero at distance 0, at the ends of all rays.

    Args:
        origins, directions, near, far, times, jitter, occupancy, aabb: see `march`; at least one ray.
        step: () length of an interval, > 0, in the rays' dtype.
        size: number of places.

    Returns:
        Intervals (size,), and how many `march` would have kept, () int64.

    Raises:
        ValueError: a shape or dtype that does not fit, no rays, or a size that is not positive.
    """
    rays, box = checked_rays(origins, directions, near, far, times, jitter, occupancy, aabb)
    if not len(near) or size < 1:
        raise ValueError(f"there must be rays and places for samples, got {len(near)} and {size}")
    if step.ndim:
        raise ValueError(f"step must be a scalar, got shape {tuple(step.shape)}")
    if choose(rays[0]) == "triton":
        *columns, wanted = run_compiled("march", "march_to_size", occupancy, rays, box, step.to(box), size)
        return MarchedSamples(*columns), wanted
    marched = march(
        origins, directions, near, far, times=times, jitter=jitter, occupancy=occupancy, aabb=aabb, step=float(step)
    )
    return fitted(marched, size)


def fitted(marched: MarchedSamples, size: int) -> tuple[MarchedSamples, Tensor]:
    """The definition of what `march_to_size` makes of what `march` returns."""
    starts, ends, indices, offsets = marched
    if not len(starts):  # one that is wanted by nobody
        starts, ends, indices = starts.new_zeros(1), ends.new_zeros(1), indices.new_zeros(1)
    counts = torch.ones_like(indices)
    counts[len(marched.starts) :] = 0
    chosen = fit(offsets, counts, size)
    starts, ends = (torch.where(chosen.is_filled, x[chosen.source], 0) for x in (starts, ends))
    return MarchedSamples(starts, ends, chosen.rays, chosen.offsets), chosen.wanted
