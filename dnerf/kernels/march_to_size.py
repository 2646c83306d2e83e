"""Marching rays through an occupancy grid into a fixed number of places, without waiting for the device."""

import torch
from torch import Tensor

from dnerf.fixed_size import fit

from .backend import choose, run_compiled
from .march import MarchedSamples, check_march, march
from .op import op


@torch.no_grad()
def march_to_size(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    *,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: Tensor,
    size: int,
) -> tuple[MarchedSamples, Tensor]:
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
    check_march(origins, directions, near, far, times, jitter, occupancy, aabb)
    if not len(near) or size < 1:
        raise ValueError(f"there must be rays and places for samples, got {len(near)} and {size}")
    if step.ndim:
        raise ValueError(f"step must be a scalar, got shape {tuple(step.shape)}")
    dtype = torch.promote_types(origins.dtype, torch.float32)
    rays = [x.to(dtype) for x in (origins, directions, near, far, times, jitter)]
    if choose(rays[0]) == "triton":
        *columns, wanted = torch.ops.dnerf.march_to_size(occupancy, rays, aabb.to(dtype), step.to(dtype), size)
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


@op("dnerf::march_to_size")
def _march_to_size(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    return run_compiled("march", "march_to_size", occupancy, rays, aabb, step, size)


@_march_to_size.register_fake
def _(
    occupancy: Tensor, rays: list[Tensor], aabb: Tensor, step: Tensor, size: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    starts = rays[0].new_empty(size)
    indices = starts.new_empty(size, dtype=torch.int64)
    offsets = indices.new_empty(rays[0].shape[0] + 1)
    return starts, starts.clone(), indices, offsets, indices.new_empty(())
