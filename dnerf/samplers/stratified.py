"""Stratified sampling: equal intervals, one random point in each."""

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive
from dnerf.core.geometry import clip_to_box
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField
from dnerf.samplers.base import Sampler


class StratifiedSampler(Sampler):
    """Divides each ray's [near, far] into equal intervals; points are random in training, middles in evaluation.

    Source: NeRF (arXiv 2003.08934) eq. 2. The random point makes the optical depth an unbiased estimate; the
    interval keeps its full length, so nothing depends on an artificial last one.

    Args:
        num_samples: S, intervals per ray.
        box: (2, 3) lowest and highest corner, outside which nothing is sampled; None for no limit.

    Raises:
        ValueError: if the number is not positive.
    """

    def __init__(self, num_samples: int = 64, box: Tensor | None = None) -> None:
        super().__init__()
        check_positive("num_samples", num_samples)
        self.num_samples = num_samples
        self.box = None if box is None else nn.Buffer(as_box(box), persistent=False)

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Dense samples (R, num_samples)."""
        near, far = rays.near, torch.maximum(rays.near, rays.far)
        if self.box is not None:
            near, far = clip_to_box(rays.origins, rays.directions, near, rays.far, self.box.to(near.dtype))
        steps = torch.linspace(0, 1, self.num_samples + 1, dtype=near.dtype, device=near.device)
        edges = torch.lerp(near[:, None], far[:, None], steps)
        starts, ends = edges[:, :-1], edges[:, 1:]
        points = random_points(starts, ends, generator) if self.training else None
        return Samples(starts, ends, len(rays), points=points)


def random_points(starts: Tensor, ends: Tensor, generator: torch.Generator | None) -> Tensor:
    """One uniform random point in each interval, laid out like `starts`."""
    u = torch.rand(starts.shape, generator=generator, dtype=starts.dtype, device=starts.device)
    return torch.lerp(starts, ends, u)
