"""The NeRF MLP as a canonical (static) field."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import check_positive, check_shape
from dnerf.compositing import FieldOutput
from dnerf.deformations.base import check_positions_times
from dnerf.encodings import SinusoidalEncoding
from dnerf.fields.activations import activate_density
from dnerf.fields.base import RadianceField
from dnerf.geometry import check_last_axis
from dnerf.mlp import MLP


class NeRFField(RadianceField):
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

    def __init__(
        self,
        num_layers: int = 8,
        hidden_features: int = 256,
        skips: Sequence[int] = (5,),
        *,
        position_frequencies: int = 10,
        view_dependent: bool = False,
        direction_frequencies: int = 4,
        density_activation: str = "softplus",
        density_shift: float = -1.0,
    ) -> None:
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

    @property
    def num_contents(self) -> int:
        """Density and colour before their activations; none if colour depends on the direction."""
        return 4 if self.encode_directions is None else 0

    def contents(self, positions: Tensor) -> Tensor:
        """Density and colour before their activations (..., 4) at canonical positions (..., 3)."""
        if self.encode_directions is not None:
            raise self._without_contents()
        check_last_axis("positions", positions, 3)
        features = self.trunk(self.encode_positions(positions))
        return torch.cat([self.to_density(features), self.to_rgb(features)], dim=-1)

    def from_contents(self, contents: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) of contents (..., 4); times are not used."""
        self._check_contents(contents, times)
        density = self._activated(contents[..., 0])
        return FieldOutput(density=density, rgb=torch.sigmoid(contents[..., 1:].to(density.dtype)))

    def _activated(self, raw: Tensor) -> Tensor:
        return activate_density(raw, self.density_activation, self.density_shift)

    def _density(self, features: Tensor) -> Tensor:
        return self._activated(self.to_density(features)[..., 0])

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3); times (...,) are not used."""
        check_positions_times(positions, times)
        return self._density(self.trunk(self.encode_positions(positions)))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at canonical positions (..., 3) seen along directions (..., 3)."""
        check_positions_times(positions, times)
        if self.encode_directions is None:
            return self.from_contents(self.contents(positions), times)
        check_shape("directions", directions, positions.shape)
        features = self.trunk(self.encode_positions(positions))
        density = self._density(features)
        features = torch.cat([self.features(features), self.encode_directions(directions)], dim=-1)
        return FieldOutput(density=density, rgb=torch.sigmoid(self.to_rgb(features).to(density.dtype)))
