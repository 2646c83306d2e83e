"""One deformation after another."""

import torch
from torch import Tensor

from dnerf.deformations.base import Deformation, InvertibleDeformation, check_positions_times
from dnerf.deformations.fixed_point import invert

SOLVED = 1e-4
"""Residual, in world units, of an inverse by fixed points with which a second, dearer try is not needed."""


class ComposedDeformation(InvertibleDeformation):
    """`second(first(x, t), t)`: canonical space of the first is where the second begins.

    Its inverse is exact where both are invertible. A first one that is not is inverted by fixed points (see `invert`),
    whose residuals `dnerf.motion.carry` reports; that inverse is not differentiable.

    Args:
        first: world -> canonical.
        second: canonical -> canonical space at one time.
    """

    def __init__(self, first: Deformation, second: InvertibleDeformation) -> None:
        super().__init__()
        self.first = first
        self.second = second

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,)."""
        return self.second(self.first(positions, times), times)

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3)."""
        check_positions_times(canonical, times)
        between = self.second.inverse(canonical, times)
        if isinstance(self.first, InvertibleDeformation):
            return self.first.inverse(between, times)
        world, residual = invert(self.first, between, times)
        left = ~(residual < SOLVED)
        again, miss = invert(self.first, between[left], times[left], guess=world[left], use_jacobian=True)
        better = (miss < residual[left])[:, None]
        return world.masked_scatter(left[..., None], torch.where(better, again, world[left]))
