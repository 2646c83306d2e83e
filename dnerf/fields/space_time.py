"""Features of places at times: products of three volumes, each over two axes of space and time."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_whole
from dnerf.core.geometry import cubes, in_unit_cube
from dnerf.deformations.base import check_positions_times
from dnerf.fields.base import HasRoughness, training_gib
from dnerf.kernels import GridLevels, grid_encode

MAX_GIB = 16  # of tables, in training


class SpaceTimeFeatures(nn.Module, ABC):
    """Features of places at times, for a head to see."""

    out_features: int

    @abstractmethod
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., n) at positions (..., 3) and times (...,) in [0, 1]."""


class LatticeFeatures(SpaceTimeFeatures, HasRoughness):
    """Tables, each over some of the axes x, y, z and t, that are interpolated at several resolutions and then joined.

    Args:
        box: (2, 3) corners of the space; positions outside see the nearest face.
        axes: of each table, two or three, time the last of four (3).
        resolutions: cells along the box's longest side, per level.
        time_resolutions: cells along time, per level.
        num_features: of a table's level, F.

    Raises:
        ValueError: for a box or sizes out of range, levels of which one list has more, or tables beyond 16 GiB.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], axes: Sequence[Sequence[int]], resolutions: Sequence[int],
        time_resolutions: Sequence[int], num_features: int,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_features", num_features)
        if len(resolutions) != len(time_resolutions):
            raise ValueError(
                f"time_resolutions must have as many levels as resolutions {list(resolutions)}, "
                f"got {list(time_resolutions)}"
            )
        for name, numbers in (("resolutions", resolutions), ("time_resolutions", time_resolutions)):
            for number in numbers:
                check_whole(name, number)
        corners = as_box(box)
        cells = [[*cubes(corners, r), t] for r, t in zip(resolutions, time_resolutions)]
        self.axes = tuple(tuple(some) for some in axes)
        rows = sum(math.prod(level[k] + 1 for k in some) for level in cells for some in self.axes)
        gib = training_gib(rows * num_features)
        if gib > MAX_GIB:
            raise ValueError(
                f"resolutions {list(resolutions)}, with {max(time_resolutions)} cells of time, need {gib:.0f} GiB in "
                f"training, of at most {MAX_GIB}: use coarser ones"
            )
        self.levels = tuple(
            GridLevels.dense([[*(level[k] for k in some), 0][:3] for level in cells]) for some in self.axes
        )
        self.tables = nn.ParameterList(
            nn.Parameter(torch.empty(levels.num_rows, num_features).uniform_(-1e-2, 1e-2)) for levels in self.levels
        )
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / (corners[1] - corners[0]), persistent=False)
        self.num_levels = len(resolutions)
        self.out_features = self.num_levels * num_features

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., L F), level by level, at positions (..., 3) and times (...,) in [0, 1]."""
        check_positions_times(positions, times)
        unit = in_unit_cube(positions, self.low, self.scale)
        columns = [*unit.unbind(-1), times.to(positions.dtype).reshape(-1)]
        values = [
            # A plane's third column counts for nothing.
            grid_encode(torch.stack([columns[k] for k in (*some, 0)[:3]], dim=-1), table, levels)
            for some, table, levels in zip(self.axes, self.tables, self.levels, strict=True)
        ]
        return self._joined(values).reshape(*times.shape, self.out_features)

    @abstractmethod
    def _joined(self, values: list[Tensor]) -> Tensor:
        """Features (N, L F) of those of each table (N, L F)."""

    def roughness(self, turn: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Mean squared differences of neighbours in space, and second differences in time, of all tables; scalars."""
        space, time = self.low.new_zeros(()), self.low.new_zeros(())
        for some, table, levels in zip(self.axes, self.tables, self.levels, strict=True):
            for (u, v, w, first, _), size in zip(levels.describe(), levels.vertices, strict=True):
                values = table[first : first + size].view(w + 1, v + 1, u + 1, -1)
                for dim, axis in zip((2, 1, 0), some):
                    if axis == 3:
                        time = time + _mean_square(values.diff(n=2, dim=dim))
                    else:
                        space = space + _mean_square(values.diff(dim=dim))
        return space, time


class SpaceTimeVolumes(LatticeFeatures):
    """Features `(1 + a(x, y, t)) (1 + b(x, z, t)) (1 + c(y, z, t)) - 1`, interpolated at several resolutions.

    A body that moves leaves a tube in each volume, and a place and time belong to it where all three tubes say so: four
    dimensions at the price of three. It is zero, and the same at all times, as long as the tables are.

    Source: Tensor4D's three time-aware volumes (arXiv 2211.11610, section 3.1), not cut into planes any further; joined
    by products around one, as K-Planes (arXiv 2301.10241, section 3.1) joins its planes.

    Arguments and errors as of `LatticeFeatures`.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (24, 48),
        time_resolutions: Sequence[int] = (25, 50), *, num_features: int = 4,
    ) -> None:  # fmt: skip
        super().__init__(box, ((0, 1, 3), (0, 2, 3), (1, 2, 3)), resolutions, time_resolutions, num_features)

    def _joined(self, values: list[Tensor]) -> Tensor:
        a, b, c = values
        return (1 + a) * (1 + b) * (1 + c) - 1


def _mean_square(values: Tensor) -> Tensor:
    """0 for none, as of second differences between two times."""
    return values.square().sum() / max(values.numel(), 1)
