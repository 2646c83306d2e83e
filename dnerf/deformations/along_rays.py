"""Deforming samples that follow each other on rays, for less than one evaluation each."""

import torch
from torch import Tensor

from dnerf.deformations.base import Deformation, check_positions_times
from dnerf.kernels import thin_out

MOST_ASKED = 0.9  # of samples, for which the interpolation still pays


def deform_along_rays(
    deformation: Deformation, positions: Tensor, times: Tensor, spacing: float, *, pad_to: int = 1024
) -> Tensor:
    """Deform samples of rays, with displacements interpolated linearly between some of them.

    Displacements vary slowly in space, while samples follow each other closely. The deformation is asked at those that
    `thin_out` chooses: of neighbours on a ray, one in every `spacing` and the last one; samples without such neighbours
    are all asked. The error is that of linear interpolation: an eighth of the second derivative along the ray times the
    square of the distance between samples asked, which is less than twice `spacing`.

    Args:
        deformation: world -> canonical.
        positions: (..., 3), world units; ray by ray, in the order in which they lie on it.
        times: (...,) in [0, 1].
        spacing: along a ray, in world units, > 0.
        pad_to: the number of samples asked is rounded up to a multiple of this, since matrix libraries compile code
            for every new number of rows.

    Returns:
        Canonical positions (..., 3), differentiable; to positions as if fractions between samples asked were constant.
    """
    check_positions_times(positions, times)
    points, moments = positions.reshape(-1, 3), times.reshape(-1)
    asked, before, fractions = thin_out(points, moments, spacing)
    if len(asked) >= MOST_ASKED * len(points):
        return deformation(positions, times)
    places = torch.cat([asked, asked[-1:].expand(-len(asked) % pad_to)])
    chosen = points.index_select(0, places)
    displacements = deformation(chosen, moments.index_select(0, places)) - chosen
    after = (before + 1).clamp_(max=len(asked) - 1)
    ends = displacements.index_select(0, before), displacements.index_select(0, after)
    return (points + torch.lerp(*ends, fractions[:, None])).reshape(positions.shape)
