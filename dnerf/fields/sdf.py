"""Surfaces as canonical fields: a signed distance on grid features, and two ways in which it absorbs light."""

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from dnerf.core.checks import check_positive, check_shape
from dnerf.core.compositing import FieldOutput
from dnerf.fields.base import IntervalAware, RadianceField, SignedDistance, ends_of
from dnerf.fields.grid import GridField


class SDFField(GridField, SignedDistance):
    """A signed distance and colour: a ball's distance plus what a head makes of grid features.

        d(x) = |x - c| - r + residual(x)

    The residual is about zero at the start: training begins with a ball in the middle of the box, whose gradient has
    length one (the geometric initialisation of SAL, arXiv 1911.10414, and IDR, as a sum instead of as weights).
    Density follows from the distance and a learnt width of the surface, whose inverse is its sharpness.

    Args:
        box, resolutions, num_features, max_rows, hidden_features, num_layers, view_degree, window_end: see `GridField`.
        radius: r, as a share of half the box's shortest side.
        width: of the surface at the start, in world units, added to `least_width`.
        least_width: below which training makes no surface; of that a sampler's steps have to see something.

    Raises:
        ValueError: for a box, resolutions or sizes out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (16, 32, 64, 128), num_features: int = 8, *,
        max_rows: int = 1 << 17, hidden_features: int = 64, num_layers: int = 2, view_degree: int | None = None,
        window_end: float | None = None, radius: float = 0.8, width: float = 0.1, least_width: float = 1e-3,
    ) -> None:  # fmt: skip
        super().__init__(
            box, resolutions, num_features, max_rows=max_rows, hidden_features=hidden_features, num_layers=num_layers,
            view_degree=view_degree, window_end=window_end,
        )  # fmt: skip
        for name, value in (("radius", radius), ("width", width), ("least_width", least_width)):
            check_positive(name, value)
        sides = 1 / self.scale
        self.center = nn.Buffer(self.low + 0.5 * sides, persistent=False)
        self.radius = 0.5 * radius * float(sides.min())
        self.least_width = least_width
        self.log_width = nn.Parameter(torch.tensor(math.log(width)))
        cells = [max(self.levels.cells[3 * i : 3 * i + 3]) for i in range(self.levels.num_levels)]
        self.cell_sizes = nn.Buffer(float(sides.max()) / torch.tensor(cells), persistent=False)
        with torch.no_grad():
            self._last[1][0] = 0

    @property
    def sharpness(self) -> Tensor:
        """One by the width of the surface (), in 1 / world unit."""
        return 1 / (self.least_width + self.log_width.exp())

    @property
    def detail(self) -> Tensor:
        """Side () of a cell of the finest level that is more than half open."""
        if self.window_end is None:
            return self.cell_sizes[-1]
        return self.cell_sizes[(self.window > 0.5).sum().clamp(min=1) - 1]

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """Itself."""
        return self

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        """Distance (...,) of the head's first output (...,)."""
        dtype = torch.promote_types(positions.dtype, torch.float32)
        return (positions.to(dtype) - self.center.to(dtype)).norm(dim=-1) - self.radius + raw.to(dtype)

    def _values_at(self, positions: Tensor, directions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (...,), and colour (..., 3) before its activation."""
        values = self._values(positions, directions, times)
        return self._distance(positions, values[..., 0]), values[..., 1:]

    @abstractmethod
    def density_of(self, distance: Tensor) -> Tensor:
        """Density (...,), in 1 / world unit, of a surface met head-on, at signed distances (...,)."""

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """Signed distance (...,), negative inside, at canonical positions (..., 3)."""
        return self._distance(positions, self._density_series(positions, times)[..., 0])

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,), head-on, at canonical positions (..., 3)."""
        return self.density_of(self.distance(positions, times))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,), head-on, and rgb (..., 3) at canonical positions (..., 3) and directions (..., 3)."""
        distance, color = self._values_at(positions, directions, times)
        return FieldOutput(self.density_of(distance), torch.sigmoid(color))


class VolSDFField(SDFField):
    """A signed distance with VolSDF's density, sharpness times the Laplace distribution's CDF of minus the distance.

        density(d) = s exp(-s d) / 2 outside, s (1 - exp(s d) / 2) inside

    It is the same from all directions. Source: VolSDF (arXiv 2106.12052) eqs. 2-3, alpha = 1 / beta; beta is the width
    here, with a floor. Deviation: samples are a sampler's, not those of their error bound.
    """

    def density_of(self, distance: Tensor) -> Tensor:
        """Density (...,) at signed distances (...,), at most the sharpness."""
        sharpness = self.sharpness
        outside = 0.5 * torch.exp(-sharpness * distance.clamp(min=0))
        inside = 1 - 0.5 * torch.exp(sharpness * distance.clamp(max=0))
        return sharpness * torch.where(distance >= 0, outside, inside)


class NeuSField(SDFField, IntervalAware):
    """A signed distance with NeuS's opacity: an interval absorbs light as far as distance falls along it.

        optical depth = max(softplus(-s d_end) - softplus(-s d_start), 0)

    A ray's light is half gone where the distance is zero, at whatever angle a plane is crossed, and what leaves a body
    absorbs nothing. Source: NeuS (arXiv 2106.10689) eqs. 10 and 13: 1 - exp(-optical depth) is their opacity
    (Phi(s d_start) - Phi(s d_end)) / Phi(s d_start), without its quotient, which underflows inside bodies. Deviation:
    colour in the middle is that of the mean of the head's outputs at both ends, which are evaluated anyway.
    """

    def density_of(self, distance: Tensor) -> Tensor:
        """Density (...,) where distance falls by one per unit of length: the most there is from any direction."""
        return self.sharpness * torch.sigmoid(-self.sharpness * distance)

    def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Mean density (...,) of intervals between positions (..., 3), head-on for those without length, and rgb."""
        check_shape("ends", ends, starts.shape)
        all_ends = ends_of(starts, ends, directions, times)
        distance, color = self._values_at(all_ends.positions, all_ends.directions, all_ends.times)
        first, last = all_ends.pairs(distance)
        # logsigmoid(x) = -softplus(-x), which torch's own softplus rounds beyond 20.
        depth = torch.relu(logsigmoid(self.sharpness * first) - logsigmoid(self.sharpness * last))
        length = (ends - starts).norm(dim=-1)
        is_long = length > 0
        density = torch.where(is_long, depth / torch.where(is_long, length, 1), self.density_of(last))
        color_first, color_last = all_ends.pairs(color)
        return FieldOutput(density, torch.sigmoid(0.5 * (color_first + color_last)))
