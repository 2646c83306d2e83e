"""A multi-resolution feature grid with a tiny head as a canonical field."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_shape, check_whole
from dnerf.core.compositing import FieldOutput
from dnerf.core.geometry import cubes, in_unit_cube
from dnerf.core.spherical_harmonics import spherical_harmonics
from dnerf.deformations.base import check_one_time, check_positions_times
from dnerf.fields.base import NetworkTabled, NetworkTables, RadianceField, warn_of_generic_path
from dnerf.fields.head import HeadedField, SpaceTimeFeatures
from dnerf.kernels import GridLevels, grid_encode, grid_network, is_bfloat16_wanted, series_sums, shade
from dnerf.nn.parameter_groups import ParameterGroup


class GridField(HeadedField):
    """Features interpolated in grids of several resolutions, then a small MLP for density and colour.

    Source: instant-ngp (Mueller et al. 2022): levels are dense while their vertices fit into `max_rows` rows and
    hashed beyond. Cells are cubes: a resolution counts cells along the box's longest side.

    Args:
        box: (2, 3) corners of the modelled space; positions outside see the features of the nearest face.
        resolutions: cells along the longest side, per level.
        num_features: features per level, F.
        max_rows: most table rows of a level, a power of two.
        hidden_features, ..., window_end: of the head, see `HeadedField`.

    Raises:
        ValueError: for a box, resolutions or sizes out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (16, 32, 64, 128), num_features: int = 8, *,
        max_rows: int = 1 << 17, hidden_features: int = 64, num_layers: int = 2, temporal_terms: int = 1,
        space_time: SpaceTimeFeatures | None = None, view_degree: int | None = None, one_color: bool = False,
        density_shift: float = -1.0, window_end: float | None = None,
    ) -> None:  # fmt: skip
        check_positive("num_features", num_features)
        for resolution in resolutions:
            check_whole("resolutions", resolution)
        corners = as_box(box)
        levels = GridLevels([cubes(corners, r) for r in resolutions], max_rows)
        table = torch.empty(levels.num_rows, num_features).uniform_(-1e-2, 1e-2)
        super().__init__(
            levels.num_levels, num_features, hidden_features=hidden_features, num_layers=num_layers,
            temporal_terms=temporal_terms, space_time=space_time, view_degree=view_degree, one_color=one_color,
            density_shift=density_shift, window_end=window_end,
        )  # fmt: skip
        self.levels = levels
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / (corners[1] - corners[0]), persistent=False)
        self.table = nn.Parameter(table)

    def parameter_groups(self) -> list[ParameterGroup]:
        """The head's, and the table in "features"."""
        return [*super().parameter_groups(), ParameterGroup("features", (self.table,))]

    def _unit(self, positions: Tensor) -> Tensor:
        """Places (N, 3) in the box, whose corners are 0 and 1."""
        return in_unit_cube(positions, self.low, self.scale)

    def _features(self, positions: Tensor, times: Tensor) -> Tensor:
        features = grid_encode(self._unit(positions), self.table, self.levels, rounded=is_bfloat16_wanted(positions))
        return features.reshape(*positions.shape[:-1], features.shape[-1])

    def _linear(self, positions: Tensor, times: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """What a linear layer makes of what the head's last one sees."""
        layers = None if torch.is_grad_enabled() else self._grid_layers()
        if layers is None:
            return super()._linear(positions, times, weight, bias)
        weights, biases = [*layers[0], weight], [*layers[1], bias]
        values = grid_network(self._unit(positions), self.table, self.levels, weights, biases)
        return values.reshape(*positions.shape[:-1], len(bias))

    def _grid_layers(self) -> tuple[list[Tensor], list[Tensor]] | None:
        """Weights and biases of the head's hidden layers, if they see the table's features and nothing else."""
        return None if self.space_time is not None else self.head.relu_parameters(self._input_scale)

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same with what depends on time alone summed up."""
        return GridFieldAtTime(self, time)


class GridFieldAtTime(RadianceField, NetworkTabled):
    """A grid field at one time, for images: its series in time are summed up in the head's last layer.

    Args:
        field: what is evaluated.
        time: in [0, 1]; the only one at which it may be evaluated.

    Raises:
        ValueError: when evaluated, for other times.
    """

    @torch.no_grad()
    def __init__(self, field: GridField, time: float) -> None:
        super().__init__()
        self.field = field
        self.time = time
        now = field.low.new_tensor(time)
        weight, bias = (part.detach() for part in field._last)
        with torch.autocast(now.device.type, enabled=False):
            waves = field._waves(now).to(weight.dtype)
            self.layers = field._grid_layers()
            self.weight = nn.Buffer(field._at_one_time(weight, waves))
            self.bias = nn.Buffer(field._at_one_time(bias[:, None], waves)[:, 0])

    def network_tables(self) -> NetworkTables | None:
        """Its tables; None, and a warning, for features of space and time, or a head without hidden layers."""
        field = self.field
        if self.layers is None:
            return warn_of_generic_path("num_layers=0" if field.space_time is None else "space_time features")
        return NetworkTables(
            low=field.low, scale=field.scale, table=field.table.detach(), levels=field.levels,
            weights=[*self.layers[0], self.weight], biases=[*self.layers[1], torch.zeros_like(self.bias)],
            shifts=self.bias + nn.functional.pad(self.bias.new_tensor([field.density_shift]), (0, len(self.bias) - 1)),
        )  # fmt: skip

    def _linear(self, positions: Tensor, times: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """What a linear layer (N, n) makes of what the head's last one sees."""
        check_positions_times(positions, times)
        check_one_time(times, self.time)
        field = self.field
        if self.layers is None:
            return field._linear(positions, times, weight, bias).reshape(-1, len(bias))
        weights, biases = [*self.layers[0], weight], [*self.layers[1], bias]
        return grid_network(field._unit(positions), field.table, field.levels, weights, biases)

    @torch.no_grad()
    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3) and times (...,)."""
        if not self.field.view_degree:
            return self(positions, positions, times).density
        logs = self._linear(positions, times, self.weight[:1], torch.zeros_like(self.bias[:1])) + self.bias[:1]
        return self.field._activated(logs).reshape(times.shape)

    @torch.no_grad()
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions (..., 3), directions (..., 3) and times (...,)."""
        degree = self.field.view_degree
        after: Tensor = self.bias
        values = self._linear(positions, times, self.weight, torch.zeros_like(self.bias))
        if degree:
            check_shape("directions", directions, positions.shape)
            basis = spherical_harmonics(directions.reshape(-1, 3), degree)
            values, after = series_sums(values + after, basis), after.new_zeros(4)
        density, rgb = shade(values, after, self.field.density_shift)
        return FieldOutput(density.reshape(times.shape), rgb.reshape(positions.shape))
