"""What a sampler is: it decides where along the rays a field is evaluated."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from dnerf.fields.base import RadianceField
from dnerf.rays import Rays, Samples


class Sampler(nn.Module, ABC):
    """Places samples along rays. Training mode may place them at random, evaluation mode never does."""

    observed: tuple[str, ...] = ()  # buffers that `observe` raises; processes that train together take their maximum
    update_every: int = 1  # steps between updates that look at them

    @abstractmethod
    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Samples along R rays, dense or packed; no gradient flows to where they lie.

        Args:
            rays: R rays.
            field: the field that will be rendered; samplers that look where matter is ask it.
            generator: source of randomness in training mode.
        """

    def update(self, field: RadianceField, step: int) -> None:
        """Learn from the field between training steps; does nothing unless overridden.

        Args:
            field: the field in training.
            step: number of training steps done so far.
        """

    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Learn from what the field said at the samples of a training step; does nothing unless overridden.

        Args:
            positions: (..., 3) of the samples, in world units.
            times: (...,) of the samples.
            density: (...,) that the field said there.
        """
