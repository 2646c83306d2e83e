"""What a deformation is: a map from world to canonical positions, one time per position."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from dnerf.core.checks import check_batch
from dnerf.core.geometry import check_last_axis
from dnerf.core.shortcuts import speaks_for


class Deformation(nn.Module, ABC):
    """Maps world positions at their times to canonical positions."""

    is_identity = False  # whether it moves nothing, at no time, and never will

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3), never offsets, of world positions (..., 3) at times (...,) in [0, 1]."""


class InvertibleDeformation(Deformation):
    """A deformation that can also carry canonical positions back to the world."""

    @abstractmethod
    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at `times` (...,) of canonical positions (..., 3)."""


class IdentityDeformation(InvertibleDeformation):
    """Canonical positions are world positions."""

    is_identity = True

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return `positions` (..., 3) as they are."""
        check_positions_times(positions, times)
        return positions

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """Return `canonical` (..., 3) as it is."""
        return self(canonical, times)


class PerFrame(ABC):
    """A deformation that has a cheaper stand-in for all positions of one frame."""

    @abstractmethod
    def at_time(self, time: float, extent: Tensor | None = None) -> Deformation:
        """The stand-in at one time in [0, 1]; if a box (2, 3) is given, for what lies in it."""


def deformation_at_time(deformation: Deformation, time: float, extent: Tensor | None = None) -> Deformation:
    """Its stand-in at a time, see `PerFrame`; itself without one, or if a subclass has another `forward` than that."""
    if isinstance(deformation, PerFrame) and speaks_for(deformation, "at_time", "forward"):
        return deformation.at_time(time, extent)
    return deformation


class WrappedDeformation(Deformation):
    """A deformation around another one, whose map it approximates: a cache."""

    def __init__(self, deformation: Deformation) -> None:
        super().__init__()
        self.deformation = deformation


def unwrapped(deformation: Deformation) -> Deformation:
    """The deformation itself, without what approximates it: whose inverse and derivatives are exact."""
    while isinstance(deformation, WrappedDeformation):
        deformation = deformation.deformation
    return deformation


def check_one_time(times: Tensor, time: float) -> None:
    """Raise unless all times are that one; padded samples carry the time of a ray, too."""
    if times.numel() and not any(times.stride()):  # one number, expanded
        times = times.reshape(-1)[:1]
    if times.numel() and not bool((times - time).abs().amax() < 1e-6):
        raise ValueError(f"times must all be {time}, got values from {times.min()} to {times.max()}")


def check_positions_times(positions: Tensor, times: Tensor) -> None:
    """Raise unless positions are (..., 3) and times have their batch shape."""
    check_last_axis("positions", positions, 3)
    check_batch("times", times, positions)
