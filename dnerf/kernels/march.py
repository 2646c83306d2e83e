"""Marching rays through a time-dependent occupancy grid."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .op import op
from .skip_distances import BLOCK_BITS, blocks_shape


class MarchedSamples(NamedTuple):
    """Packed intervals along rays.

    Attributes:
        starts: (N,) distance where the interval starts.
        ends: (N,) distance where it ends; > starts.
        ray_indices: (N,) int64, sorted.
        offsets: (R + 1,) int64; ray r owns samples `offsets[r] : offsets[r + 1]`.
    """

    starts: Tensor
    ends: Tensor
    ray_indices: Tensor
    offsets: Tensor


class MarchGrid(NamedTuple):
    """What rays of one time are marched through.

    Attributes:
        occupancy: (Gx, Gy, Gz) bool.
        skips: `skip_distances` of it, without the axis of slabs.
        aabb: (2, 3), lower and upper corner of the box that the cells fill, in world units.
        step: length of an interval, in world units.
        splits: parts into which those in which something is seen are cut.
        split_weight: weight in the picture up to which they are not.
    """

    occupancy: Tensor
    skips: Tensor
    aabb: Tensor
    step: float
    splits: int = 1
    split_weight: float = 0.0

    def extent(self) -> Tensor:
        """A box (2, 3) that holds all kept intervals: blocks of cells, and half an interval around them."""
        bounds = []
        for axis in range(3):
            blocks = (self.skips == 0).movedim(axis, 0).flatten(1).any(1).nonzero()[:, 0].tolist()
            bounds.append((blocks[0], blocks[-1] + 1) if blocks else (0, 0))
        cells = torch.tensor(bounds, device=self.aabb.device).T << BLOCK_BITS
        size = torch.tensor(self.occupancy.shape, device=self.aabb.device)
        corners = torch.lerp(self.aabb[0], self.aabb[1], torch.minimum(cells, size) / size)
        return corners + self.step * corners.new_tensor([[-0.5], [0.5]])


@torch.no_grad()
def march(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    *,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
    max_samples_per_ray: int | None = None,
    skips: Tensor | None = None,
) -> MarchedSamples:
    """Cut rays into intervals of one length and keep those whose midpoint lies in an occupied cell.

    Ray r's interval k is `[near + (k - 1 + jitter) step, near + (k + jitter) step]`, clipped to the part of
    [near, far] inside the box; those of no length are dropped. Not differentiable.

    Args:
        origins: (R, 3), world units.
        directions: (R, 3), unit norm; components may be zero.
        near, far: (R,) range of distances; `far` may be infinite, a ray with near >= far gets no samples.
        times: (R,), in [0, 1]; time t reads slab `min(floor(t K), K - 1)`.
        jitter: (R,), in [0, 1): shift of the ray's intervals, in steps.
        occupancy: (K, Gx, Gy, Gz) bool, on one device with the rays.
        aabb: (2, 3), lower and upper corner of the box that the occupancy grid fills.
        step: length of an interval, > 0.
        max_samples_per_ray: keep only the first so many of each ray.
        skips: `skip_distances(occupancy)`, which changes no result; worth keeping with a grid that is marched more
            than once, since it is computed here otherwise.

    Returns:
        The kept intervals, ray by ray, in order of distance.

    Raises:
        ValueError: a shape or dtype that does not fit, or a step that is not positive.
    """
    check_march(origins, directions, near, far, times, jitter, occupancy, aabb)
    if not step > 0:
        raise ValueError(f"step must be positive, got {step}")
    if max_samples_per_ray is not None and max_samples_per_ray < 1:
        raise ValueError(f"max_samples_per_ray must be at least 1, got {max_samples_per_ray}")
    if skips is not None and skips.shape != blocks_shape(occupancy):
        raise ValueError(f"skips must have shape {blocks_shape(occupancy)}, got {tuple(skips.shape)}")
    dtype = torch.promote_types(origins.dtype, torch.float32)
    rays = [x.to(dtype) for x in (origins, directions, near, far, times, jitter)]
    arguments: tuple[Any, ...] = (*rays, occupancy, aabb.to(dtype), float(step), max_samples_per_ray)
    if choose(rays[0]) == "reference":
        return march_reference(*arguments)
    return MarchedSamples(*torch.ops.dnerf.march(*arguments, skips))


def check_march(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
) -> None:
    """Raise ValueError unless shapes and dtypes are those that `march` asks for."""
    num_rays = origins.shape[0]
    for name, value in (("origins", origins), ("directions", directions)):
        if value.shape != (num_rays, 3):
            raise ValueError(f"{name} must have shape ({num_rays}, 3), got {tuple(value.shape)}")
    for name, value in (("near", near), ("far", far), ("times", times), ("jitter", jitter)):
        if value.shape != (num_rays,):
            raise ValueError(f"{name} must have shape ({num_rays},), got {tuple(value.shape)}")
    if occupancy.ndim != 4 or occupancy.dtype != torch.bool or not occupancy.numel():
        raise ValueError(
            f"occupancy must be bool of shape (K, Gx, Gy, Gz), got {occupancy.dtype} {tuple(occupancy.shape)}"
        )
    if aabb.shape != (2, 3):
        raise ValueError(f"aabb must have shape (2, 3), got {tuple(aabb.shape)}")


def march_reference(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
    max_samples_per_ray: int | None,
) -> MarchedSamples:
    """The definition of `march` in plain torch: it tests every interval of every ray.

    The compiled versions round like this one, operation by operation, and so return the same bits.
    """
    starts, ends, keep = kept_intervals(origins, directions, near, far, times, jitter, occupancy, aabb, step)
    if max_samples_per_ray is not None:
        keep &= keep.cumsum(-1) <= max_samples_per_ray
    offsets = torch.nn.functional.pad(keep.sum(-1).cumsum(0), (1, 0))
    return MarchedSamples(starts[keep], ends[keep], keep.nonzero()[:, 0], offsets)


def kept_intervals(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Start and end of every interval that a ray may have, and which are kept, (R, J) each."""
    enter, leave, first, counts = interval_ranges(origins, directions, near, far, jitter, aabb, step)
    num_intervals = int(counts.max()) if len(counts) else 0
    index = first[:, None] + torch.arange(num_intervals, device=near.device).to(near.dtype)
    starts = (near[:, None] + (index - 1 + jitter[:, None]) * step).maximum(enter[:, None])
    ends = (near[:, None] + (index + jitter[:, None]) * step).minimum(leave[:, None])

    middles = (starts + ends) * 0.5
    shape = torch.tensor(occupancy.shape[1:], device=occupancy.device)
    positions = origins[:, None] + directions[:, None] * middles[..., None]
    cells = (positions - aabb[0]) * (shape.to(aabb.dtype) / (aabb[1] - aabb[0]))
    cells = cells.floor().long().clamp(min=torch.zeros_like(shape), max=shape - 1)
    slabs = (times * occupancy.shape[0]).long().clamp(0, occupancy.shape[0] - 1)
    keep = (counts > 0)[:, None] & (ends > starts) & occupancy[(slabs[:, None], *cells.unbind(-1))]
    return starts, ends, keep


def interval_ranges(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, aabb: Tensor, step: float | Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The part of [near, far] inside the closed box, and the intervals that may overlap with it.

    Returns:
        Four tensors (R,), all in the rays' dtype: entry, exit, number of the first interval, and how many there may
        be; zero for a ray that misses the box or is not finite.
    """
    parallel = directions == 0
    divisor = directions.masked_fill(parallel, 1)
    lower, upper = (aabb[0] - origins) / divisor, (aabb[1] - origins) / divisor
    outside = torch.where((origins >= aabb[0]) & (origins <= aabb[1]), -torch.inf, torch.inf).to(near.dtype)
    enter = torch.where(parallel, outside, lower.minimum(upper)).amax(-1).maximum(near)
    leave = torch.where(parallel, -outside, lower.maximum(upper)).amin(-1).minimum(far)
    length = leave - enter
    hit = (length > 0) & length.isfinite()
    first = torch.where(hit, ((enter - near) / step - jitter).floor(), 0)
    return enter, leave, first, torch.where(hit, (length / step).ceil() + 3, 0)


@op("dnerf::march")
def _march(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
    max_samples_per_ray: int | None,
    skips: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return run_compiled(
        "march",
        "march",
        origins,
        directions,
        near,
        far,
        times,
        jitter,
        occupancy,
        aabb,
        step,
        max_samples_per_ray,
        skips,
    )


@_march.register_fake
def _(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    times: Tensor,
    jitter: Tensor,
    occupancy: Tensor,
    aabb: Tensor,
    step: float,
    max_samples_per_ray: int | None,
    skips: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    num_samples = torch.library.get_ctx().new_dynamic_size()
    starts = origins.new_empty(num_samples)
    indices = origins.new_empty(num_samples, dtype=torch.int64)
    return starts, starts.clone(), indices, near.new_empty(near.shape[0] + 1, dtype=torch.int64)
