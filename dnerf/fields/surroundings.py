"""What lies beyond the box: a radiance field of contracted space, behind which nothing is."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.backgrounds import Background
from dnerf.core.checks import as_box, check_choice, check_whole
from dnerf.core.compositing import render_weights
from dnerf.core.contraction import SHAPES, contract
from dnerf.core.geometry import ray_box
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField

LEAST_DISTANCE = 1e-3  # world units; what lies at the eye itself is not seen


class SurroundingsBackground(Background):
    """A field of all that lies beyond a box, at rest, seen where light gets through the box.

    Intervals begin where a ray leaves the box and are even in disparity, up to infinity: their ends are at
    `leave + scale u / (1 - u)` for even u, with half of the box's longest side as the scale. The last interval is
    opaque: what is infinitely far has a colour of its own. Rays that miss the box begin at their near plane.

    The density of the field is per half of the box's longest side, divided by the square of the distance in units of
    the box, by which the contraction shortens lengths along a ray.

    Source: NeRF++ (arXiv 2010.07492) section 4 for the split, mip-NeRF 360 (arXiv 2111.12077) section 3 for the
    contraction and the disparities.

    Args:
        box: (2, 3) corners of what is modelled inside.
        field: radiance field over [-2, 2]^3, see `dnerf.core.contraction.contract`.
        num_intervals: of each ray.
        shape: of what the contraction leaves as it is, "box" or "ball".

    Raises:
        ValueError: for fewer than two intervals, or another shape.
    """

    shows_beyond = True

    def __init__(
        self, box: Sequence[Sequence[float]], field: RadianceField, num_intervals: int = 16, *, shape: str = "box"
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("shape", shape, SHAPES)
        check_whole("num_intervals", num_intervals)
        if num_intervals < 2:
            raise ValueError(f"num_intervals must be at least 2, got {num_intervals}")
        self.field = field
        self.num_intervals, self.shape = num_intervals, shape
        self.box = nn.Buffer(as_box(box), persistent=False)

    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
        """Colours (R, 3); intervals are shifted at random in training."""
        samples = self._place(rays, generator)
        positions, directions, times = samples.locate(rays)
        contracted, distances = contract(positions, self.box, self.shape)
        output = self.field(contracted, directions, times)
        lengths = samples.lengths / (0.5 * (self.box[1] - self.box[0]).max()) / distances.square()
        depths = output.density[:, :-1] * lengths[:, :-1]
        depths = torch.cat([depths, torch.full_like(depths[:, :1], torch.inf)], dim=-1)
        return (render_weights(depths, samples)[..., None] * output.rgb).sum(1)

    def _place(self, rays: Rays, generator: torch.Generator | None) -> Samples:
        enter, leave = ray_box(rays.origins, rays.directions, self.box)
        begin = torch.where((enter < leave) & (leave > 0), leave, rays.near).clamp(min=LEAST_DISTANCE)[:, None]
        steps = torch.arange(self.num_intervals + 1, device=begin.device, dtype=begin.dtype)
        inner = steps[1:-1].expand(len(begin), -1)
        if self.training:
            shift = torch.rand(len(begin), 1, generator=generator, device=begin.device, dtype=begin.dtype)
            inner = inner + shift - 0.5
        shares = torch.cat([torch.zeros_like(begin), inner / self.num_intervals], dim=-1)
        ends = begin + 0.5 * (self.box[1] - self.box[0]).max() * shares / (1 - shares)
        last = ends[:, -1:] * 2 - begin  # infinity is drawn from somewhere
        return Samples(ends, torch.cat([ends[:, 1:], last], dim=-1), len(rays))
