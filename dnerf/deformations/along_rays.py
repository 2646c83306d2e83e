"""Deforming samples that follow each other on rays, for less than one evaluation each."""

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.deformations.base import (
    Deformation,
    PerFrame,
    WrappedDeformation,
    check_positions_times,
    deformation_at_time,
)
from dnerf.kernels import thin_out

MOST_EVALUATED = 0.9  # of samples, for which the interpolation still pays
PAD_TO = 1024  # samples: matrix libraries compile code for every new number of rows


class AlongRaysDeformation(WrappedDeformation, PerFrame):
    """Another deformation; in training its displacements are interpolated along rays, see `deform_along_rays`.

    In evaluation mode it is the other deformation itself.

    Args:
        deformation: world -> canonical.
        spacing: along a ray, in world units, > 0, at which it is evaluated.

    Raises:
        ValueError: if the spacing is not positive.
    """

    def __init__(self, deformation: Deformation, spacing: float) -> None:
        super().__init__(deformation)
        check_positive("spacing", spacing)
        self.spacing = spacing

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of positions (..., 3), ray by ray in training, at times (...,)."""
        if not self.training or self.deformation.is_identity:
            return self.deformation(positions, times)
        return deform_along_rays(self.deformation, positions, times, self.spacing)

    def at_time(self, time: float, extent: Tensor | None = None) -> Deformation:
        """The other deformation's stand-in, or itself."""
        return deformation_at_time(self.deformation, time, extent)


def deform_along_rays(
    deformation: Deformation, positions: Tensor, times: Tensor, spacing: float, *, pad_to: int = PAD_TO
) -> Tensor:
    """Deform samples of rays, with displacements interpolated linearly between some of them.

    Displacements vary slowly in space, while samples follow each other closely. The deformation is evaluated at those
    that `thin_out` chooses: of neighbours on a ray, one in every `spacing` and the last one; samples without such
    neighbours are all evaluated. The error is that of linear interpolation: an eighth of the second derivative along
    the ray times the square of the distance between them, which is less than twice `spacing`.

    Args:
        deformation: world -> canonical.
        positions: (..., 3), world units; ray by ray, in the order in which they lie on it.
        times: (...,) in [0, 1].
        spacing: along a ray, in world units, > 0.
        pad_to: a multiple of so many samples is evaluated.

    Returns:
        Canonical positions (..., 3), differentiable; to positions as if the fractions in between were constant.
    """
    check_positions_times(positions, times)
    points, point_times = positions.reshape(-1, 3), times.reshape(-1)
    chosen, before, fractions = thin_out(points, point_times, spacing)
    if len(chosen) >= MOST_EVALUATED * len(points):
        return deformation(positions, times)
    places = torch.cat([chosen, chosen[-1:].expand(-len(chosen) % pad_to)])
    known = points.index_select(0, places)
    displacements = deformation(known, point_times.index_select(0, places)) - known
    after = (before + 1).clamp_(max=len(chosen) - 1)
    ends = displacements.index_select(0, before), displacements.index_select(0, after)
    return (points + torch.lerp(*ends, fractions[:, None])).reshape(positions.shape)
