"""The NeRF MLP as a canonical (static) field."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_positive, check_shape
from dnerf.core.compositing import FieldOutput
from dnerf.deformations.base import check_positions_times
from dnerf.fields.activations import activate_density
from dnerf.fields.base import RadianceField, TimeDependence
from dnerf.nn.encodings import SinusoidalEncoding
from dnerf.nn.mlp import MLP


class NeRFField(RadianceField, TimeDependence):
    """NeRF's network: an MLP of the encoded position gives density and features, a small head the colour.

    Source: NeRF (arXiv 2003.08934) section 3 and appendix A. Deviations: the density activation is a shifted
    softplus instead of ReLU (no dead start), and without view dependence the directional branch does not
    exist at all.

    Args:
        num_layers: hidden layers of the trunk.
        hidden_features: their width.
        skips: trunk layers that see the encoded position again.
        position_frequencies: octaves of the positions' encoding.
        view_dependent: whether colour depends on the viewing direction.
        direction_frequencies: octaves of the directions' encoding, used only if view-dependent.
        density_activation: "softplus" or "exp".
        density_shift: added before the activation.

    Raises:
        ValueError: for sizes that are not positive, or skips that name no layer.
    """

    is_static = True

    def __init__(
        self, num_layers: int = 8, hidden_features: int = 256, skips: Sequence[int] = (5,), *,
        position_frequencies: int = 10, view_dependent: bool = False, direction_frequencies: int = 4,
        density_activation: str = "softplus", density_shift: float = -1.0,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_layers", num_layers)
        self.density_activation = density_activation
        self.density_shift = density_shift
        self.encode_positions = SinusoidalEncoding(3, position_frequencies)
        self.trunk = MLP(self.encode_positions.out_features, hidden_features, num_layers, skips=skips)
        self.to_density = nn.Linear(hidden_features, 1)
        self.encode_directions: SinusoidalEncoding | None = None
        if view_dependent:
            self.encode_directions = SinusoidalEncoding(3, direction_frequencies)
            self.features: nn.Module = nn.Linear(hidden_features, hidden_features)
            in_features = hidden_features + self.encode_directions.out_features
            self.to_rgb: nn.Module = MLP(in_features, hidden_features // 2, 1, out_features=3)
        else:
            self.to_rgb = nn.Linear(hidden_features, 3)

    def _density(self, features: Tensor) -> Tensor:
        return activate_density(self.to_density(features)[..., 0], self.density_activation, self.density_shift)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3); times (...,) are not used."""
        check_positions_times(positions, times)
        return self._density(self.trunk(self.encode_positions(positions)))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at canonical positions (..., 3) seen along directions (..., 3)."""
        check_positions_times(positions, times)
        features = self.trunk(self.encode_positions(positions))
        density = self._density(features)
        if self.encode_directions is not None:
            check_shape("directions", directions, positions.shape)
            features = torch.cat([self.features(features), self.encode_directions(directions)], dim=-1)
        return FieldOutput(density=density, rgb=torch.sigmoid(self.to_rgb(features).to(density.dtype)))
