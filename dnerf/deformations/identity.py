"""No deformation: the scene is static."""

from torch import Tensor

from dnerf.deformations.base import InvertibleDeformation, check_positions_times


class IdentityDeformation(InvertibleDeformation):
    """Canonical positions are world positions."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Return `positions` (..., 3) as they are."""
        check_positions_times(positions, times)
        return positions

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """Return `canonical` (..., 3) as it is."""
        check_positions_times(canonical, times)
        return canonical
