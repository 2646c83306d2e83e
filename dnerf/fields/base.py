"""What a radiance field is: density and colour at positions and times."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from dnerf.compositing import FieldOutput


class RadianceField(nn.Module, ABC):
    """Density and colour of light at world positions and times."""

    @abstractmethod
    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) >= 0 in 1 / world unit at positions (..., 3) and times (...,) in [0, 1]."""

    @abstractmethod
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density and colour.

        Args:
            positions: (..., 3) in world units.
            directions: (..., 3) unit viewing directions, from the eye into the scene.
            times: (...,) in [0, 1].

        Returns:
            `FieldOutput` with density (...,) and rgb (..., 3) in [0, 1].
        """

    @property
    def is_fixed(self) -> bool:
        """Whether density and colour are known to depend on the position alone, not on time and direction."""
        return False

    def finished(self) -> "RadianceField":
        """The field to ask once nothing is learnt any more; itself, unless something can be kept between frames."""
        return self

    def at_time(self, time: float) -> "RadianceField":
        """The field to ask while a frame of one time is rendered; itself, unless something can be kept for it.

        Args:
            time: in [0, 1]; what is returned may be asked at no other.
        """
        return self
