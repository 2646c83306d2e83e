"""A displacement whose network sees features of a coarse grid: parts that move apart are told apart at once."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import as_box, check_positive
from dnerf.deformations.base import Deformation, check_positions_times
from dnerf.encodings import SinusoidalEncoding
from dnerf.kernels import GridLevels, grid_encode
from dnerf.mlp import MLP


class GridDeformation(Deformation):
    def __init__(
        self,
        box: Sequence[Sequence[float]],
        resolutions: Sequence[int] = (16, 32),
        num_features: int = 4,
        *,
        max_rows: int = 1 << 17,
        hidden_features: int = 64,
        num_layers: int = 2,
        position_frequencies: int = 3,
        time_frequencies: int = 5,
    ) -> None:
        super().__init__()
        check_positive("num_features", num_features)
        corners = as_box(box)
        sides = corners[1] - corners[0]
        cells = [[max(1, round(r * float(s / sides.max()))) for s in sides] for r in resolutions]
        self.levels = GridLevels(cells, max_rows)
        self.register_buffer("low", corners[0], persistent=False)
        self.register_buffer("scale", 1 / sides, persistent=False)
        self.low: Tensor
        self.scale: Tensor
        self.table = nn.Parameter(torch.empty(self.levels.num_rows, num_features).uniform_(-1e-2, 1e-2))
        self.encode_positions = SinusoidalEncoding(3, position_frequencies)
        self.encode_times = SinusoidalEncoding(1, time_frequencies)
        self.mlp = MLP(
            num_features * self.levels.num_levels + self.encode_positions.out_features + self.encode_times.out_features,
            hidden_features,
            num_layers,
            out_features=3,
            zero_output=True,
        )

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        check_positions_times(positions, times)
        unit = (positions - self.low.to(positions.dtype)) * self.scale.to(positions.dtype)
        features = grid_encode(unit.reshape(-1, 3), self.table, self.levels)
        features = features.reshape(*positions.shape[:-1], features.shape[-1])
        encoded = torch.cat([features, self.encode_positions(positions), self.encode_times(times[..., None])], dim=-1)
        return positions + self.mlp(encoded).to(positions.dtype)
