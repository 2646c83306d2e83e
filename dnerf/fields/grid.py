"""A multi-resolution feature grid with a tiny head as a canonical field."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_shape, check_whole
from dnerf.core.compositing import FieldOutput
from dnerf.core.schedules import Scheduled
from dnerf.deformations.base import check_one_time, check_positions_times
from dnerf.fields.activations import activate_density
from dnerf.fields.base import NetworkTabled, NetworkTables, RadianceField, TimeDependence
from dnerf.fields.space_time import SpaceTimeVolumes
from dnerf.kernels import GridLevels, grid_encode, grid_network, is_bfloat16_wanted, shade
from dnerf.nn.encodings import SinusoidalEncoding, SphericalHarmonicsEncoding
from dnerf.nn.mlp import MLP
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup


class GridField(RadianceField, TimeDependence, DeclaresGroups, Scheduled):
    """Features interpolated in grids of several resolutions, then a small MLP for density and colour.

    Source: instant-ngp (Mueller et al. 2022): levels are dense while their vertices fit into `max_rows` rows and
    hashed beyond. Cells are cubes: a resolution counts cells along the box's longest side. Parts a scene does not
    need do not exist: no change with time without `temporal_terms` or `space_time`, no directions without
    `view_degree`.

    Args:
        box: (2, 3) corners of the modelled space; positions outside see the features of the nearest face.
        resolutions: cells along the longest side, per level.
        num_features: features per level, F.
        max_rows: most table rows of a level, a power of two.
        hidden_features: width of the head.
        num_layers: hidden layers of the head.
        time_frequencies: octaves of a time encoding that the head sees; None for a head that does not depend on time.
        temporal_terms: terms K of a cosine series in time, cos(k pi t) for k < K, that density and colour follow before
            their activations: folds and shading that change while matter moves. 1 for matter that is carried along
            and never changes.
        space_time: features of place and time that the head sees, too: for what moves too fast, or in too many ways,
            for a deformation to follow. None for a head that does not see any.
        view_degree: spherical-harmonics degree of the direction that a second, colour-only head sees; None for matte.
        density_activation: "softplus" or "exp".
        density_shift: added before the activation; negative for a thin start.
        window_end: fraction of training, in (0, 1], at which every level is in; finer levels fade in one after the
            other, so that a deformation is first found by coarse shapes, whose gradients reach far (Nerfies, arXiv
            2011.12948, eq. 8, for grids). None for all levels from the start.

    Raises:
        ValueError: for a box, resolutions or sizes out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (16, 32, 64, 128), num_features: int = 8, *,
        max_rows: int = 1 << 17, hidden_features: int = 64, num_layers: int = 2, time_frequencies: int | None = None,
        temporal_terms: int = 1, space_time: SpaceTimeVolumes | None = None, view_degree: int | None = None,
        density_activation: str = "exp", density_shift: float = -1.0, window_end: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_features", num_features)
        check_positive("temporal_terms", temporal_terms)
        if window_end is not None and not 0 < window_end <= 1:
            raise ValueError(f"window_end must be in (0, 1] or None, got {window_end}")
        for resolution in resolutions:
            check_whole("resolutions", resolution)
        corners = as_box(box)
        sides = corners[1] - corners[0]
        cells = [[max(1, round(r * float(s / sides.max()))) for s in sides] for r in resolutions]
        self.levels = GridLevels(cells, max_rows)
        self.density_activation = density_activation
        self.density_shift = density_shift
        self.window_end = window_end
        levels = torch.arange(self.levels.num_levels)
        self.window = nn.Buffer((levels == 0).float(), persistent=window_end is not None)
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / sides, persistent=False)
        self.table = nn.Parameter(torch.empty(self.levels.num_rows, num_features).uniform_(-1e-2, 1e-2))
        self.encode_times = None if time_frequencies is None else SinusoidalEncoding(1, time_frequencies)
        self.encode_directions = None if view_degree is None else SphericalHarmonicsEncoding(view_degree)
        self.space_time = space_time
        self.temporal_terms = temporal_terms
        self.orders = nn.Buffer(torch.arange(temporal_terms), persistent=False)
        in_features = num_features * self.levels.num_levels
        if self.encode_times is not None:
            in_features += self.encode_times.out_features
        if space_time is not None:
            in_features += space_time.out_features
        if self.encode_directions is None:
            self.head = MLP(in_features, hidden_features, num_layers, out_features=4 * temporal_terms)
            _begin_constant(self.head, 4, temporal_terms)
        else:
            self.head = MLP(in_features, hidden_features, num_layers, out_features=temporal_terms + hidden_features)
            _begin_constant(self.head, 1, temporal_terms)
            in_colors = hidden_features + self.encode_directions.out_features
            self.to_rgb = MLP(in_colors, hidden_features, 1, out_features=3 * temporal_terms)
            _begin_constant(self.to_rgb, 3, temporal_terms)

    @property
    def _is_series(self) -> bool:
        """Whether the head's outputs are all there is: it sees neither times, nor directions."""
        return self.encode_times is None and self.encode_directions is None

    @property
    def is_static(self) -> bool:
        """Whether neither the head nor its series sees times."""
        return self.encode_times is None and self.space_time is None and self.temporal_terms == 1

    def parameter_groups(self) -> list[ParameterGroup]:
        """The networks in "head"; features, which wait long for their turn, are left in "default"."""
        return [ParameterGroup("head", tuple(self.head.parameters()))]

    def set_progress(self, progress: float) -> None:
        """Open the window to where training stands, `progress` in [0, 1]; no effect without a window."""
        if self.window_end is None:
            return
        levels = torch.arange(len(self.window), device=self.window.device)
        opened = (len(levels) - 1) * min(progress / self.window_end, 1.0) - levels + 1
        self.window.copy_(0.5 * (1 - torch.cos(math.pi * opened.clamp(0, 1))))

    def _unit(self, positions: Tensor) -> Tensor:
        """Places (N, 3) in the box, whose corners are 0 and 1."""
        return (positions - self.low.to(positions.dtype)).mul_(self.scale.to(positions.dtype)).reshape(-1, 3)

    @property
    def _feature_scale(self) -> Tensor | None:
        """Of each of the table's features; None for 1."""
        return None if self.window_end is None else self.window.repeat_interleave(self.table.shape[1])

    def _inputs(self, positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the head sees (..., n), and the scale (n,) of each column."""
        features = grid_encode(self._unit(positions), self.table, self.levels, rounded=is_bfloat16_wanted(positions))
        features = features.reshape(*positions.shape[:-1], features.shape[-1])
        scale = self._feature_scale
        if self.encode_times is not None:
            features, scale = _joined(features, scale, self.encode_times(times[..., None]))
        if self.space_time is not None:
            features, scale = _joined(features, scale, self.space_time(positions, times))
        return features, scale

    def _linear(self, positions: Tensor, times: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """What a linear layer makes of what the head's last one sees."""
        layers = None if torch.is_grad_enabled() else self._grid_layers()
        if layers is not None:
            weights, biases = [*layers[0], weight], [*layers[1], bias]
            values = grid_network(self._unit(positions), self.table, self.levels, weights, biases)
            return values.reshape(*positions.shape[:-1], len(bias))
        seen = self.head.before_output(*self._inputs(positions, times))
        return nn.functional.linear(seen, weight, bias)

    def _grid_layers(self) -> tuple[list[Tensor], list[Tensor]] | None:
        """Weights and biases of the head's hidden layers, if they see the table's features and nothing else."""
        if self.encode_times is not None or self.space_time is not None:
            return None
        return self.head.relu_parameters(self._feature_scale)

    def _raw(self, positions: Tensor, times: Tensor) -> Tensor:
        """The head's outputs."""
        assert self.head.output is not None
        return self._linear(positions, times, self.head.output.weight, self.head.output.bias)

    def _activated(self, raw: Tensor) -> Tensor:
        return activate_density(raw, self.density_activation, self.density_shift)

    def _at(self, series: Tensor, times: Tensor) -> Tensor:
        """Values (..., n) of series (..., n K) at times (...,), or at one time ()."""
        if self.temporal_terms == 1:
            return series
        dtype = torch.promote_types(torch.promote_types(series.dtype, times.dtype), torch.float32)
        waves = self._waves(times.to(dtype))
        terms = series.to(dtype).unflatten(-1, (-1, self.temporal_terms))
        if times.ndim:
            return (terms * waves[..., None, :]).sum(-1)
        with torch.autocast(terms.device.type, enabled=False):
            return terms @ waves

    def _waves(self, times: Tensor) -> Tensor:
        """The series' cosines (..., K) at times (...,)."""
        return torch.cos(math.pi * self.orders.to(times.dtype) * times[..., None])

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same with its series summed up, if it sees no directions."""
        return GridFieldAtTime(self, time) if self._is_series else self

    def _activated_values(self, values: Tensor) -> FieldOutput:
        values = values.float() if values.dtype in (torch.float16, torch.bfloat16) else values
        # Of all columns, then without the first: what lies in one row is several times quicker.
        return FieldOutput(density=self._activated(values[..., 0]), rgb=torch.sigmoid(values)[..., 1:])

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        return self._activated(self._at(self._raw(positions, times)[..., : self.temporal_terms], times)[..., 0])

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at canonical positions (..., 3), directions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        raw = self._raw(positions, times)
        if self.encode_directions is None:
            return self._activated_values(self._at(raw, times))
        check_shape("directions", directions, positions.shape)
        features = torch.relu(raw[..., self.temporal_terms :])
        colors = self.to_rgb(torch.cat([features, self.encode_directions(directions)], dim=-1))
        return self._activated_values(self._at(torch.cat([raw[..., : self.temporal_terms], colors], dim=-1), times))


class GridFieldAtTime(RadianceField, NetworkTabled):
    """A grid field at one time, for images: its series are summed up in the head's last layer, not at every sample.

    Args:
        field: what is evaluated; its head sees neither times nor directions.
        time: in [0, 1]; the only one at which it may be evaluated.

    Raises:
        ValueError: for another field; when evaluated, for other times.
    """

    def __init__(self, field: GridField, time: float) -> None:
        super().__init__()
        last = field.head.output
        if not field._is_series or last is None:
            raise ValueError("field must be one whose head sees neither times nor directions")
        waves = field._waves(field.low.new_tensor(time)).to(last.weight.dtype)
        self.field = field
        self.time = time
        with torch.autocast(waves.device.type, enabled=False):
            weight = torch.einsum("ckh,k->ch", last.weight.detach().unflatten(0, (4, -1)), waves)
            bias = last.bias.detach().unflatten(0, (4, -1)) @ waves
        self.weight = nn.Buffer(weight)
        self.bias = nn.Buffer(bias)

    def network_tables(self) -> NetworkTables | None:
        """Its tables; None for another density than the exponential one, or with features of space and time."""
        field, layers = self.field, self.field._grid_layers()
        if layers is None or field.density_activation != "exp":
            return None
        return NetworkTables(
            low=field.low, scale=field.scale, table=field.table.detach(), levels=field.levels,
            weights=[*layers[0], self.weight], biases=[*layers[1], torch.zeros_like(self.bias)],
            shifts=self.bias + self.bias.new_tensor([field.density_shift, 0, 0, 0]),
        )  # fmt: skip

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3) and times (...,)."""
        return self(positions, positions, times).density

    @torch.no_grad()
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions (..., 3), for all directions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        check_one_time(times, self.time)
        if self.field.density_activation != "exp":
            return self.field._activated_values(self.field._linear(positions, times, self.weight, self.bias))
        products = self.field._linear(positions, times, self.weight, torch.zeros_like(self.bias)).reshape(-1, 4)
        density, rgb = shade(products, self.bias, self.field.density_shift)
        return FieldOutput(density.reshape(times.shape), rgb.reshape(positions.shape))


def _joined(features: Tensor, scale: Tensor | None, more: Tensor) -> tuple[Tensor, Tensor | None]:
    """More columns (..., m), of scale 1, behind others."""
    scale = None if scale is None else nn.functional.pad(scale, (0, more.shape[-1]), value=1)
    return torch.cat([features, more], dim=-1), scale


@torch.no_grad()
def _begin_constant(network: MLP, num_series: int, num_terms: int) -> None:
    """Let the series that a fresh network's first outputs are begin without the terms that change."""
    assert network.output is not None
    for part in (network.output.weight, network.output.bias):
        part[: num_series * num_terms].unflatten(0, (num_series, num_terms))[:, 1:] = 0
