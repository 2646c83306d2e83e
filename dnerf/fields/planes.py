"""Features of places and times from planes, each over two axes of space and time, and the field of a head on them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_choice, check_positive, check_whole
from dnerf.deformations.base import check_positions_times
from dnerf.fields.base import HasRoughness
from dnerf.fields.head import HeadedField
from dnerf.fields.space_time import SpaceTimeFeatures, dense_levels, mean_square
from dnerf.kernels import grid_encode

AXES = ((0, 1), (0, 2), (1, 2), (2, 3), (1, 3), (0, 3))
"""The axes of each plane, time the last of four: three of space, then for each of them what it leaves out."""

JOINS = ("product", "pairs")


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
        ValueError: for a box or sizes out of range, or another way to join.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (64, 128, 256), num_times: int | None = 25,
        *, num_features: int = 8, join: str = "product",
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("join", join, JOINS)
        check_positive("num_features", num_features)
        for resolution in resolutions:
            check_whole("resolutions", resolution)
        if num_times is not None:
            check_whole("num_times", num_times)
        corners = as_box(box)
        sides = corners[1] - corners[0]
        cells = [[*(max(1, round(r * float(s / sides.max()))) for s in sides), num_times or 0] for r in resolutions]
        self.axes = AXES if num_times is not None else AXES[:3]
        self.join = join
        self.levels = tuple(dense_levels([[level[i], level[j], 0] for level in cells]) for i, j in self.axes)
        self.planes = nn.ParameterList(
            torch.ones(levels.num_rows, num_features)
            if 3 in axes
            else torch.empty(levels.num_rows, num_features).uniform_(0.1, 0.5)
            for axes, levels in zip(self.axes, self.levels, strict=True)
        )
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / sides, persistent=False)
        self.num_levels = len(cells)
        self.num_features = num_features * (3 if join == "pairs" else 1)
        self.out_features = self.num_levels * self.num_features

    @property
    def is_static(self) -> bool:
        """Whether there are planes of space alone."""
        return len(self.axes) == 3

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Features (..., L F), or (..., L 3 F) of pairs, level by level, at positions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        dtype = positions.dtype
        unit = ((positions - self.low.to(dtype)) * self.scale.to(dtype)).reshape(-1, 3)
        columns = [*unit.unbind(-1), times.to(dtype).reshape(-1)]
        values = [
            grid_encode(torch.stack([columns[i], columns[j], torch.zeros_like(columns[i])], dim=-1), plane, levels)
            for (i, j), plane, levels in zip(self.axes, self.planes, self.levels, strict=True)
        ]
        if not self.is_static:
            values = [a * b for a, b in zip(values[:3], values[3:], strict=True)]
        if self.join == "product":
            features = values[0] * values[1] * values[2]
        else:
            features = torch.cat([x.unflatten(-1, (self.num_levels, -1)) for x in values], dim=-1)
        return features.reshape(*times.shape, self.out_features)

    def roughness(self) -> tuple[Tensor, Tensor]:
        """Mean squared differences of neighbours in space, and second differences in time, of all planes; scalars."""
        space, time = [], [self.low.new_zeros(())]
        for axes, plane, levels in zip(self.axes, self.planes, self.levels, strict=True):
            for (u, v, _, first, _), size in zip(levels.describe(), levels.vertices, strict=True):
                values = plane[first : first + size].view(v + 1, u + 1, -1)
                space.append(mean_square(values.diff(dim=1)))
                if 3 in axes:
                    time.append(mean_square(values.diff(n=2, dim=0)))
                else:
                    space.append(mean_square(values.diff(dim=0)))
        return torch.stack(space).sum(), torch.stack(time).sum()


class PlanesField(HeadedField):
    """A small head on features of planes: K-Planes' hybrid, of four dimensions without a deformation, or canonical.

    Source: K-Planes (arXiv 2301.10241) section 3.3. Deviations: density and colour have one network in common, and
    colour follows directions by harmonics, if at all; samples by occupancy in place of proposals.

    Args:
        planes: features of places and times.
        hidden_features, ..., window_end: of the head, see `HeadedField`.

    Raises:
        ValueError: for sizes out of range.
    """

    def __init__(
        self, planes: PlaneFeatures, *, hidden_features: int = 64, num_layers: int = 2,
        temporal_terms: int = 1, space_time: SpaceTimeFeatures | None = None, view_degree: int | None = None,
        density_activation: str = "exp", density_shift: float = -1.0, window_end: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__(
            planes.num_levels, planes.num_features, hidden_features=hidden_features, num_layers=num_layers,
            temporal_terms=temporal_terms, space_time=space_time, view_degree=view_degree,
            density_activation=density_activation, density_shift=density_shift, window_end=window_end,
        )  # fmt: skip
        self.planes = planes

    @property
    def is_static(self) -> bool:
        """Whether neither planes nor head see times."""
        return super().is_static and self.planes.is_static

    def _features(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.planes(positions, times)
