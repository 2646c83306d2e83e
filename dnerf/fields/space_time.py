"""Features of places at times, for a head to see beside a field's own."""

from abc import ABC, abstractmethod

from torch import Tensor, nn


class SpaceTimeFeatures(nn.Module, ABC):
    """Features of places at times, for a head to see."""

    out_features: int

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., n) at positions (..., 3) and times (...,) in [0, 1]."""
