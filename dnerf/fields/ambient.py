"""Ambient coordinates: where in a family of canonical scenes a place is, at a time."""

import torch
from torch import Tensor

from dnerf.core.checks import check_whole
from dnerf.deformations.base import check_positions_times
from dnerf.fields.head import SpaceTimeFeatures
from dnerf.nn.encodings import SinusoidalEncoding, TimeEncoding
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup, network_groups


class AmbientCoordinates(SpaceTimeFeatures, DeclaresGroups):
    """Coordinates w(x, t) that a slicing network gives, encoded: the head sees one canonical scene for each w.

    A deformation cannot tear or join what it moves. Here what parts, meets or vanishes is a smooth way through
    canonical scenes of more dimensions. The network begins at zero, and with a window so do all features: a fresh
    field is as without them.

    Source: HyperNeRF (arXiv 2106.13228) section 3.2 and eq. 7, "deformable slicing surface", with a window as of its
    section 4.1. Deviations: time is encoded, with embeddings, in place of a latent code for each frame; behind a
    deformation x is the canonical position, there the observed one; w itself is seen beside its waves.

    Args:
        num_coordinates: W; 0 for a field without.
        hidden_features: width of the slicing network.
        num_layers: its hidden layers.
        position_frequencies: octaves of the positions' encoding.
        time_frequencies: octaves of the times' encoding.
        time_embeddings: learnt embeddings of time, see `TimeEncoding`; 0 for none.
        ambient_frequencies: octaves of the coordinates' own encoding.
        window_end: fraction of training, in (0, 1], at which these are in, one after the other. None for all from the
            start; their cosines are then one at the start, not zero.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, num_coordinates: int = 2, *, hidden_features: int = 64, num_layers: int = 4,
        position_frequencies: int = 3, time_frequencies: int = 5, time_embeddings: int = 0,
        ambient_frequencies: int = 1, window_end: float | None = 0.5,
    ) -> None:  # fmt: skip
        super().__init__()
        check_whole("num_coordinates", num_coordinates, allow_zero=True)
        self.out_features = 0
        if num_coordinates == 0:
            return
        self.encode_positions = SinusoidalEncoding(3, position_frequencies)
        self.encode_times = TimeEncoding(time_frequencies, time_embeddings)
        self.slicing = MLP(
            self.encode_positions.out_features + self.encode_times.out_features, hidden_features, num_layers,
            out_features=num_coordinates, zero_output=True,
        )  # fmt: skip
        self.encode = SinusoidalEncoding(num_coordinates, ambient_frequencies, window_end=window_end)
        self.out_features = self.encode.out_features

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """The coordinates and their waves (..., n) at positions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        if self.out_features == 0:
            return positions[..., :0]
        encoded = [*self.encode_positions.parts(positions), *self.encode_times.parts(times[..., None])]
        return self.encode(self.slicing(torch.cat(encoded, dim=-1)).to(positions.dtype))

    def parameter_groups(self) -> list[ParameterGroup]:
        """As of a deformation, which it stands beside."""
        return network_groups(self, "deformation", self.slicing.output if self.out_features else None)
