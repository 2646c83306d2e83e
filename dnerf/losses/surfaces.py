"""Terms about surfaces: a signed distance is one."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_whole
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Schedule
from dnerf.fields.base import RadianceField, SignedDistance, surface_of
from dnerf.fields.normals import differences
from dnerf.losses.base import Batch, Loss
from dnerf.losses.deformation import spread_numbers
from dnerf.rendering.renderer import Renderer

PLASTIC = 1.2207440846057596  # root of x^4 = x + 1: Kronecker's sequence in three dimensions (Roberts 2018)


def canonical_surface(field: RadianceField) -> SignedDistance | None:
    """What has a surface in canonical space, behind all deformations; None if nothing has."""
    surfaces = [part for part in field.modules() if isinstance(part, RadianceField) and surface_of(part)]
    return surface_of(surfaces[-1]) if surfaces else None  # parts come after what they are part of


class EikonalLoss(Loss):
    """The gradient of a signed distance has length one: the mean of `(|grad d| - 1)^2`, in canonical space.

    At some of a batch's own samples, and at as many places spread over a box. The gradient is that of central
    differences over a cell of the finest open level of the grid: they reach into neighbouring cells, so that surfaces
    become smooth, and need no second derivatives.

    Source: IGR (arXiv 2002.10099) eq. 2; differences that follow the levels from Neuralangelo (arXiv 2306.03092)
    section 3.2.

    Args:
        box: (2, 3) corners of the space in which places lie, in world units.
        weight, every: see `Loss`.
        num_points: samples of each batch, and as many places in the box.

    Raises:
        ValueError: for a box that is none, a negative weight, or no points.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], weight: float | Schedule = 1e-2, num_points: int = 256, *, every: int = 1
    ) -> None:
        super().__init__(weight, every=every)
        check_whole("num_points", num_points)
        self.num_points = num_points
        self.box = nn.Buffer(as_box(box), persistent=False)
        self.num_calls = nn.Buffer(torch.zeros((), dtype=torch.int64))
        self.generators = nn.Buffer(PLASTIC ** -torch.arange(1, 4, dtype=torch.float64), persistent=False)

    def check(self, model: Renderer) -> None:
        """Needs a field with a signed distance."""
        if canonical_surface(model.field) is None:
            raise ValueError(f"EikonalLoss needs a field with a signed distance, got {type(model.field).__name__}")

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """Mean squared deviation from one; other places at every call."""
        surface = canonical_surface(model.field)
        assert surface is not None
        assert rendering.output is not None
        self.to(rendering.rgb.device)
        self.num_calls.add_(1)
        number = self.num_calls * self.num_points + torch.arange(self.num_points, device=rendering.rgb.device)
        unit = (number[:, None] * self.generators % 1).to(rendering.rgb.dtype)
        places = [torch.lerp(self.box[0].to(unit.dtype), self.box[1].to(unit.dtype), unit)]
        times = [unit[:, 0] * 0]
        extras = rendering.output.extras
        if "canonical_positions" in extras:
            chosen = spread_numbers(extras["times"].shape, self.num_points, unit.device)
            places.append(extras["canonical_positions"].detach().reshape(-1, 3)[chosen])
            times.append(extras["times"].reshape(-1)[chosen])
        gradients = differences(surface, torch.cat(places), torch.cat(times), surface.detail)
        return (gradients.norm(dim=-1) - 1).square().mean()
