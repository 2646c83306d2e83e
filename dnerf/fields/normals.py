"""Normals of fields, by automatic differentiation, and a field whose colour is its normal."""

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.geometry import safe_normalize
from dnerf.deformations.base import check_positions_times
from dnerf.fields.base import IntervalAware, RadianceField, SignedDistance, field_at_time, interval_aware, surface_of

FAINT = 1e-3  # opacity, up to which the direction of what an image shows is rounding


def normals(field: RadianceField, positions: Tensor, times: Tensor) -> Tensor:
    """Unit normals (..., 3), outwards, at positions (..., 3) and times (...,); zero where the field is level.

    The gradient of a signed distance, or minus that of density, to world positions: automatic differentiation pulls it
    back through a deformation. No gradient flows further.

    Raises:
        ValueError: for shapes that do not fit, or a field that is not differentiable to positions.
    """
    check_positions_times(positions, times)
    with torch.enable_grad(), torch.autocast(positions.device.type, enabled=False):
        x = positions.detach().requires_grad_()
        surface = surface_of(field)
        values = -field.density(x, times) if surface is None else surface.distance(x, times)
        if not values.requires_grad:
            raise ValueError(f"field must be differentiable to positions, got {type(field).__name__}")
        (gradient,) = torch.autograd.grad(values.sum(), x, allow_unused=True)
    return torch.zeros_like(positions) if gradient is None else safe_normalize(gradient)


def differences(
    surface: SignedDistance, positions: Tensor, times: Tensor, step: Tensor | float
) -> tuple[Tensor, Tensor]:
    """Gradients (N, 3) of a distance at positions (N, 3) from central differences, which can be trained by.

    And how much its slopes along the axes change over the step, the squares' sum (N,): at most 2 (step / R)^2 at
    the surface of a ball of radius R. The step is in world units. Unlike `normals` they serve deformations of one frame
    kept on a lattice, too.
    """
    steps = step * torch.eye(3, dtype=positions.dtype, device=positions.device)
    # Networks in half precision round by as much as the differences are.
    with torch.autocast(positions.device.type, enabled=False):
        places = positions + torch.cat([steps, -steps, 0 * steps[:1]])[:, None]
        up, down, here = surface.distance(places, times.expand(7, -1)).split([3, 3, 1])
    return ((up - down) / (2 * step)).mT, ((up + down - 2 * here) / step).square().sum(0)


class NormalField(RadianceField, IntervalAware, SignedDistance):
    """A field whose colour is its normal n, as (n + 1) / 2: the same renderer makes images of normals.

    Composited without a background, 2 rgb - opacity is the weighted sum of normals, see `normals_of_image`.

    Args:
        field: whose density it has.
        exact: whose normals it has; the field if None. A frame's own field may be approximate, without derivatives.
    """

    def __init__(self, field: RadianceField, exact: RadianceField | None = None) -> None:
        super().__init__()
        self.field = field
        self.exact = field if exact is None else exact

    @property
    def knows_intervals(self) -> bool:
        """Whether the field does."""
        return interval_aware(self.field) is not None

    @property
    def has_surface(self) -> bool:
        """Whether the field has one."""
        return surface_of(self.field) is not None

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """Signed distance (...,) of the field."""
        surface = surface_of(self.field)
        assert surface is not None, "called only if has_surface"
        return surface.distance(positions, times)

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The density of the field at that time, with the same normals."""
        return NormalField(field_at_time(self.field, time, extent), self.exact)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) of the field."""
        return self.field.density(positions, times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) of the field, and its normals as rgb (..., 3)."""
        return self._with_normals(self.field.density(positions, times), positions, times)

    def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Mean density (...,) of the field's intervals, and normals in their middle as rgb (..., 3)."""
        aware = interval_aware(self.field)
        assert aware is not None, "called only if knows_intervals"
        density = aware.between(starts, ends, directions, times).density
        return self._with_normals(density, 0.5 * (starts + ends), times)

    def _with_normals(self, density: Tensor, positions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(density, 0.5 * (normals(self.exact, positions, times) + 1))


def normals_of_image(rgb: Tensor, opacity: Tensor) -> Tensor:
    """Unit normals (..., 3) of what a `NormalField` shows before black, rgb and opacity (...,); zero if faint."""
    return torch.where(opacity[..., None] > FAINT, safe_normalize(2 * rgb - opacity[..., None]), 0)
