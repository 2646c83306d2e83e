"""Features of places and times from planes, each over two axes of space and time, and the field of a head on them."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_choice, check_whole
from dnerf.fields.head import HeadedField
from dnerf.fields.space_time import LatticeFeatures, SpaceTimeFeatures

AXES = ((0, 1), (0, 2), (1, 2), (2, 3), (1, 3), (0, 3))
"""The axes of each plane, time the last of four: three of space, then for each of them what it leaves out."""

JOINS = ("product", "pairs")


class PlaneFeatures(LatticeFeatures):
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
        check_choice("join", join, JOINS)
        axes, num_times = (AXES[:3], 1) if num_times is None else (AXES, num_times)
        check_whole("num_times", num_times)
        super().__init__(box, axes, resolutions, [num_times] * len(resolutions), num_features)
        for some, plane in zip(axes, self.tables, strict=True):
            nn.init.ones_(plane) if 3 in some else nn.init.uniform_(plane, 0.1, 0.5)
        self.join = join
        self.out_features *= 3 if join == "pairs" else 1

    @property
    def is_static(self) -> bool:
        """Whether there are planes of space alone."""
        return len(self.tables) == 3

    def _joined(self, values: list[Tensor]) -> Tensor:
        if not self.is_static:
            values = [a * b for a, b in zip(values[:3], values[3:], strict=True)]
        if self.join == "product":
            return values[0] * values[1] * values[2]
        return torch.cat([x.unflatten(-1, (self.num_levels, -1)) for x in values], dim=-1)  # level by level


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
