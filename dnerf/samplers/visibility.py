"""Which of a ray's samples can be seen: those that are neither empty nor hidden behind opaque matter."""

from collections.abc import Callable

import torch
from torch import Tensor

from dnerf.fields.base import RadianceField
from dnerf.kernels import packed_sum, packed_weights
from dnerf.rays import Rays, Samples

Observer = Callable[[Tensor, Tensor, Tensor], None]


@torch.no_grad()
def visible_samples(
    samples: Samples,
    rays: Rays,
    field: RadianceField,
    min_weight: float,
    *,
    first_round: int = 8,
    pad_to: int = 1,
    observe: Observer | None = None,
) -> Tensor:
    """Ask the field's density front to back and mark the samples whose weight exceeds `min_weight`.

    Rays are walked in rounds of `first_round` samples, twice as many, and so on; a ray whose transmittance has
    fallen to `min_weight` takes no further part, so what lies behind a surface costs nothing (early ray
    termination: Levoy 1990; as a filter before the pass with gradients: nerfacc). A picture of the marked samples
    alone differs from that of all by at most `min_weight` for each sample in front and `min_weight` for all behind.

    Args:
        samples: N packed samples of the rays.
        rays: R rays.
        field: whose density decides.
        min_weight: least weight that counts, in (0, 1).
        first_round: samples per ray in the first round.
        pad_to: the field is asked a multiple of so many points.
        observe: told positions (n, 3), times (n,) and density (n,) of every round.

    Returns:
        (N,) bool.
    """
    assert samples.ray_indices is not None
    origins, directions, times = rays.origins, rays.directions, rays.times
    per_ray = torch.cat([origins, directions, times[:, None]], dim=-1)
    marked = torch.zeros_like(samples.starts, dtype=torch.bool)
    depth = torch.zeros_like(rays.near)
    counts = samples.offsets.diff()
    taken, size = 0, first_round
    open_rays = (counts > 0).nonzero()[:, 0]
    while len(open_rays):
        used = (counts[open_rays] - taken).clamp(max=size)
        offsets = torch.nn.functional.pad(used.cumsum(0), (1, 0))
        total = int(offsets[-1])
        local = torch.repeat_interleave(used, output_size=total)
        chosen = torch.arange(total, device=local.device) + (samples.offsets[open_rays] + taken - offsets[:-1])[local]
        rows = per_ray.index_select(0, open_rays.index_select(0, local))
        positions = torch.addcmul(rows[:, :3], samples.distances[chosen, None], rows[:, 3:6])
        density = _padded_density(field, positions, rows[:, 6], pad_to)
        if observe is not None:
            observe(positions, rows[:, 6], density)
        optical_depth = density * samples.lengths[chosen]
        before = depth[open_rays]
        weights = packed_weights(optical_depth, offsets) * torch.exp(-before)[local]
        marked[chosen] = weights > min_weight
        before = before + packed_sum(optical_depth, None, offsets)
        depth[open_rays] = before
        taken += size
        size *= 2
        open_rays = open_rays[(torch.exp(-before) > min_weight) & (counts[open_rays] > taken)]
    return marked


def _padded_density(field: RadianceField, positions: Tensor, times: Tensor, pad_to: int) -> Tensor:
    count = len(times)
    padding = -count % pad_to
    if padding:
        positions = torch.cat([positions, positions[-1:].expand(padding, 3)])
        times = torch.cat([times, times[-1:].expand(padding)])
    return field.density(positions, times)[:count]
