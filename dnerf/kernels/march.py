"""Marching rays through a time-dependent occupancy grid."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dnerf.core.checks import check_positive, check_shape, check_whole

from .backend import choose
from .checks import check_cells, check_shapes
from .op import op
from .skip_distances import BLOCK_BITS, blocks_shape


class MarchedSamples(NamedTuple):
    """Packed intervals along rays.

    Attributes:
        starts, ends: (N,) distances where the interval starts and where it ends; ends > starts.
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
        occupancy, skips: (Gx, Gy, Gz) bool, and `skip_distances` of it, without the axis of slabs.
        aabb: (2, 3), lower and upper corner of the box that the cells fill, in world units.
        step: length of an interval, in world units.
        subdivision: parts into which those in which something is visible are cut.
        subdivision_weight: weight in the image up to which they are not.
    """

    occupancy: Tensor
    skips: Tensor
    aabb: Tensor
    step: float
    subdivision: int = 1
    subdivision_weight: float = 0.0

    def extent(self) -> Tensor:
        """A box (2, 3) that holds all kept intervals: blocks of cells, and half an interval around them."""
        bounds = []
        for axis in range(3):
            blocks = (self.skips == 0).movedim(axis, 0).flatten(1).any(1).nonzero()[:, 0].tolist()
            bounds.append((blocks[0], blocks[-1] + 1) if blocks else (0, 0))
        cells = torch.tensor(bounds, device=self.aabb.device).T << BLOCK_BITS
        size = torch.tensor(self.occupancy.shape, device=self.aabb.device)
        shares = (torch.minimum(cells, size) / size).to(self.aabb.dtype)
        corners = torch.lerp(self.aabb[0], self.aabb[1], shares)
        return corners + self.step * corners.new_tensor([[-0.5], [0.5]])


@torch.no_grad()
def march(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, *, times: Tensor, jitter: Tensor, occupancy: Tensor,
    aabb: Tensor, step: float, max_samples_per_ray: int | None = None, skips: Tensor | None = None,
) -> MarchedSamples:  # fmt: skip
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
        skips: `skip_distances(occupancy)`, which changes no result; computed here if None.

    Returns:
        The kept intervals, ray by ray, in order of distance.

    Raises:
        ValueError: a shape or dtype that does not fit, or a step that is not positive.
    """
    rays, box = checked_rays(origins, directions, near, far, times, jitter, occupancy, aabb)
    check_positive("step", step)
    if max_samples_per_ray is not None:
        check_whole("max_samples_per_ray", max_samples_per_ray)
    if skips is not None:
        check_shape("skips", skips, blocks_shape(occupancy))
    if choose(rays[0]) == "reference":
        return march_reference(rays, occupancy, box, float(step), max_samples_per_ray)
    return MarchedSamples(*_march(occupancy, rays, box, float(step), max_samples_per_ray, skips))


_march = op(
    "march(Tensor occupancy, Tensor[] rays, Tensor aabb, float step, int? limit, Tensor? skips)"
    " -> (Tensor, Tensor, Tensor, Tensor)",
    "march.march",
)


def checked_rays(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, times: Tensor, jitter: Tensor, occupancy: Tensor,
    aabb: Tensor,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """The six tensors of rays, and the box, in one dtype; ValueError unless they are as `march` asks."""
    each = origins.shape[:1]
    check_shapes(origins=(origins, (*each, 3)), directions=(directions, (*each, 3)), aabb=(aabb, (2, 3)))
    check_shapes(near=(near, each), far=(far, each), times=(times, each), jitter=(jitter, each))
    check_cells("occupancy", occupancy, "K, Gx, Gy, Gz", least=1)
    dtype = torch.promote_types(origins.dtype, torch.float32)
    return [x.to(dtype) for x in (origins, directions, near, far, times, jitter)], aabb.to(dtype)


def march_reference(
    rays: Sequence[Tensor], occupancy: Tensor, aabb: Tensor, step: float, max_samples_per_ray: int | None
) -> MarchedSamples:
    """The definition of `march` in plain torch: it tests every interval of every ray.

    The compiled versions round like this one, operation by operation, and so return the same bits.
    """
    starts, ends, keep = kept_intervals(rays, occupancy, aabb, step)
    if max_samples_per_ray is not None:
        keep &= keep.cumsum(-1) <= max_samples_per_ray
    offsets = torch.nn.functional.pad(keep.sum(-1).cumsum(0), (1, 0))
    return MarchedSamples(starts[keep], ends[keep], keep.nonzero()[:, 0], offsets)


def kept_intervals(
    rays: Sequence[Tensor], occupancy: Tensor, aabb: Tensor, step: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Start and end of every interval that a ray may have, and which are kept, (R, J) each."""
    origins, directions, near, far, times, jitter = rays
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
