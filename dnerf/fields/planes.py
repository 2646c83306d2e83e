"""Features of places and times from planes, each over two axes of space and time, and the field of a head on them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_choice, check_positive, check_whole
from dnerf.core.geometry import cubes, in_unit_cube
from dnerf.deformations.base import check_positions_times
from dnerf.fields.base import HasRoughness, training_gib
from dnerf.fields.head import HeadedField, SpaceTimeFeatures
from dnerf.kernels import GridLevels, grid_encode

AXES = ((0, 1), (0, 2), (1, 2), (2, 3), (1, 3), (0, 3))
"""The axes of each plane, time the last of four: three of space, then for each of them what it leaves out."""

JOINS = ("product", "pairs")
MAX_GIB = 16  # of planes, in training


class PlaneFeatures(SpaceTimeFeatures, HasRoughness):
    """Products of planes, interpolated at several resolutions: four dimensions at the price of two.

    Joined by a "product", a feature is `a(x, y) b(x, z) c(y, z) d(z, t) e(y, t) f(x, t)` (K-Planes): what all six agree
    on. Joined in "pairs", it is three, `a(x, y) d(z, t)`, `b(x, z) e(y, t)` and `c(y, z) f(x, t)` (HexPlane). Either is
    exact for a product of functions of x, y, z and t. Planes of time begin at one: nothing moves before it has to.

    Source: K-Planes (arXiv 2301.10241) eq. 1 to 3, at several resolutions in space and one in time; HexPlane (arXiv
    2301.09632) eq. 5, whose vectors are the next layer's weights.

    Args:
        box: (2, 3) corners of the space; positions outside see the nearest face.
        resolutions: cells along the box's longest side, per level.
        num_times: cells along time; None for planes of space alone.
        num_features: of a plane's level, F.
        join: "product" or "pairs".

    Raises:
        ValueError: for a box or sizes out of range, planes beyond 16 GiB, or another way to join.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (64, 128, 256), num_times: int | None = 25,
        *, num_features: int = 8, join: str = "product",
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("join", join, JOINS)
        check_positive("num_features", num_features)
        self.axes = AXES[:3] if num_times is None else AXES
        num_times = 1 if num_times is None else num_times
        for name, numbers in (("resolutions", resolutions), ("num_times", [num_times])):
            for number in numbers:
                check_whole(name, number)
        corners = as_box(box)
        cells = [[*cubes(corners, resolution), num_times] for resolution in resolutions]
        gib = training_gib(num_features * sum((n[i] + 1) * (n[j] + 1) for n in cells for i, j in self.axes))
        if gib > MAX_GIB:
            raise ValueError(
                f"resolutions {list(resolutions)}, with {num_times} cells of time, need {gib:.0f} GiB in training, of "
                f"at most {MAX_GIB}: use coarser ones"
            )
        self.levels = tuple(GridLevels.dense([[n[i], n[j], 0] for n in cells]) for i, j in self.axes)
        empty = (torch.empty(levels.num_rows, num_features) for levels in self.levels)
        self.tables = nn.ParameterList(map(nn.Parameter, empty))
        for some, plane in zip(self.axes, self.tables, strict=True):
            nn.init.ones_(plane) if 3 in some else nn.init.uniform_(plane, 0.1, 0.5)
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / (corners[1] - corners[0]), persistent=False)
        self.join, self.num_levels = join, len(resolutions)
        self.out_features = self.num_levels * num_features * (3 if join == "pairs" else 1)

    @property
    def is_static(self) -> bool:
        """Whether there are planes of space alone."""
        return len(self.tables) == 3

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., n), level by level, at positions (..., 3) and times (...,) in [0, 1]."""
        check_positions_times(positions, times)
        unit = in_unit_cube(positions, self.low, self.scale)
        columns = [*unit.unbind(-1), times.to(positions.dtype).reshape(-1)]
        values = [
            # A plane's third column counts for nothing.
            grid_encode(torch.stack([columns[i], columns[j], columns[0]], dim=-1), table, levels)
            for (i, j), table, levels in zip(self.axes, self.tables, self.levels, strict=True)
        ]
        return self._joined(values).reshape(*times.shape, self.out_features)

    def _joined(self, values: list[Tensor]) -> Tensor:
        if not self.is_static:
            values = [a * b for a, b in zip(values[:3], values[3:], strict=True)]
        if self.join == "product":
            return values[0] * values[1] * values[2]
        return torch.cat([x.unflatten(-1, (self.num_levels, -1)) for x in values], dim=-1)  # level by level

    def roughness(self, turn: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Mean squared differences of neighbours in space, and second differences in time, of all planes; scalars."""
        space, time = self.low.new_zeros(()), self.low.new_zeros(())
        for (_, second), table, levels in zip(self.axes, self.tables, self.levels, strict=True):
            for (u, v, _, first, _), size in zip(levels.describe(), levels.vertices, strict=True):
                values = table[first : first + size].view(v + 1, u + 1, -1)
                space = space + _mean_square(values.diff(dim=1))
                if second == 3:
                    time = time + _mean_square(values.diff(n=2, dim=0))
                else:
                    space = space + _mean_square(values.diff(dim=0))
        return space, time


def _mean_square(values: Tensor) -> Tensor:
    """0 for none, as of second differences between two times."""
    return values.square().sum() / max(values.numel(), 1)


class PlanesField(HeadedField):
    """A small head on features of planes: K-Planes' hybrid, of four dimensions without a deformation, or canonical.

    Source: K-Planes (arXiv 2301.10241) section 3.3. Deviations: density and colour have one network in common, and
    colour follows directions by harmonics, if at all; samples by occupancy in place of proposals.

    Args:
        planes: features of places and times.
        hidden_features, ..., window_end: of the head, and errors: see `HeadedField`.
    """

    def __init__(
        self, planes: PlaneFeatures, *, hidden_features: int = 64, num_layers: int = 2,
        temporal_terms: int = 1, space_time: SpaceTimeFeatures | None = None, view_degree: int | None = None,
        one_color: bool = False, density_shift: float = -1.0, window_end: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__(
            planes.num_levels, planes.out_features // planes.num_levels, hidden_features=hidden_features,
            num_layers=num_layers, temporal_terms=temporal_terms, space_time=space_time, view_degree=view_degree,
            one_color=one_color, density_shift=density_shift, window_end=window_end,
        )  # fmt: skip
        self.planes = planes

    @property
    def is_static(self) -> bool:
        """Whether neither planes nor head see times."""
        return super().is_static and self.planes.is_static

    def _features(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.planes(positions, times)
