"""What a deformation is: a map from world to canonical positions, one time per position."""

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from dnerf.checks import check_batch
from dnerf.geometry import check_last_axis


@runtime_checkable
class BeginsAtZero(Protocol):
    """A part that may be zero at initialisation, so that what it moves stays where it is."""

    def rest(self) -> None:
        """Be zero again, if it was zero then."""


class Deformation(nn.Module, ABC):
    """Maps world positions at their times to canonical positions."""

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions of world positions.

        Args:
            positions: (..., 3) in world units.
            times: (...,) in [0, 1], one per position.

        Returns:
            (..., 3) canonical positions in world units: positions, never offsets.
        """

    def begin_anew(self) -> None:
        """Be the identity again, as at initialisation; what its last layers see stays as it is."""
        for part in self.modules():
            if isinstance(part, BeginsAtZero):
                part.rest()


class InvertibleDeformation(Deformation):
    """A deformation that can also carry canonical positions back to the world."""

    @abstractmethod
    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at `times` (...,) of canonical positions (..., 3)."""


def check_one_time(times: Tensor, time: float) -> None:
    """Raise unless all times are that one; padded samples carry the time of a ray, too.

    Raises:
        ValueError: saying which there are.
    """
    if times.numel() and not any(times.stride()):  # one number, expanded
        times = times.reshape(-1)[:1]
    if times.numel() and not bool((times - time).abs().amax() < 1e-6):
        raise ValueError(f"times must all be {time}, got values from {times.min()} to {times.max()}")


def check_positions_times(positions: Tensor, times: Tensor) -> None:
    """Raise unless positions are (..., 3) and times have their batch shape.

    Raises:
        ValueError: naming the argument and its shape.
    """
    check_last_axis("positions", positions, 3)
    check_batch("times", times, positions)
