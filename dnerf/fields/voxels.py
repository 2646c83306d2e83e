"""Voxels: density and harmonics of colour kept in grids, without a network."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_choice, check_positive, check_shape, check_whole, check_within
from dnerf.core.compositing import FieldOutput
from dnerf.core.geometry import cubes, in_unit_cube
from dnerf.core.schedules import Scheduled
from dnerf.core.spherical_harmonics import DEGREES, spherical_harmonics
from dnerf.deformations.base import check_positions_times
from dnerf.fields.activations import activate_density
from dnerf.fields.base import HasRoughness, RadianceField, TimeDependence, training_gib
from dnerf.fields.head import VIEW_SCALE, open_levels
from dnerf.kernels import GridLevels, grid_encode
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup

LAYERS = 16  # of a table that roughness looks at: at all of 256 cells each way, it takes as long as fifty steps
STRIDE = 7919  # between the first layers of two turns, modulo how many there are: a prime visits them all


class VoxelField(RadianceField, TimeDependence, DeclaresGroups, HasRoughness, Scheduled):
    """Density and spherical harmonics of colour, interpolated in voxels; there is no network.

    Density is `a(s sum_l w_l D_l(x) + b)` with an activation a, a scale s and a shift b, and colour is
    `sigmoid(sum_l w_l sum_k C_lk(x) Y_k(d))`: D and C are tables of level l, trilinear between vertices, w_l opens
    finer levels one after the other. Levels are summed up: coarse ones hold the scene, finer ones, which begin at
    zero, what these cannot. So resolution grows without a table that changes its shape, and a gradient reaches far
    through the coarse levels and near through the fine ones.

    Source: Plenoxels (arXiv 2112.05131), sections 3.1 to 3.3. Deviations: levels are summed up where theirs are
    resampled; activations other than the ReLU, which gives no gradient where it is zero; empty space is left out by the
    sampler's occupied cells, not by a sparse table; harmonics beside the constant are kept in coarse levels only.

    Gradients and Adam touch every number, so most of a step's time goes there, not to samples: large batches pay.

    Args:
        box: (2, 3) corners of the modelled space; positions outside see the nearest face.
        resolutions: cells along the box's longest side, per level, ascending; cells are cubes.
        view_degree: degree, 0 to 4, of the harmonics of the direction that colour follows; 0 for matte.
        view_resolution: the finest level's, at most, that has harmonics beside the constant.
        density_activation: "softplus" or "exp".
        density_shift: added before the activation; negative for a thin start.
        density_scale: of the tables' densities: all numbers take steps of one size, and density has further to go.
        window_end: fraction of training, in (0, 1], at which every level is open; None for all from the start.
        max_gib: most memory that training may need for the tables, in GiB.

    Raises:
        ValueError: for a box or numbers out of range, no level with harmonics, or tables too large for `max_gib`.
    """

    is_static = True

    def __init__(
        self, box: Sequence[Sequence[float]], resolutions: Sequence[int] = (32, 64, 128, 256), *, view_degree: int = 2,
        view_resolution: int = 64, density_activation: str = "exp", density_shift: float = -1.0,
        density_scale: float = 4.0, window_end: float | None = None, max_gib: float = 4.0,
    ) -> None:  # fmt: skip
        super().__init__()
        check_choice("view_degree", view_degree, DEGREES)
        for name, value in (("view_resolution", view_resolution), *(("resolutions", r) for r in resolutions)):
            check_whole(name, value)
        check_positive("density_scale", density_scale)
        check_positive("max_gib", max_gib)
        if not resolutions or list(resolutions) != sorted(set(resolutions)):
            raise ValueError(f"resolutions must ascend, one level at least, got {list(resolutions)}")
        if view_degree and view_resolution < resolutions[0]:
            raise ValueError(
                f"view_resolution must be {resolutions[0]}, the first level's, or more, got {view_resolution}"
            )
        check_within("window_end", window_end, "(0, 1]", or_none=True)
        corners = as_box(box)
        cells = [cubes(corners, r) for r in resolutions]
        rows = [math.prod(c + 1 for c in level) for level in cells]
        self.num_viewed = sum(r <= view_resolution for r in resolutions) if view_degree else 0
        self.view_degree = view_degree
        columns = 3 * ((view_degree + 1) ** 2 - 1)
        gib = training_gib(4 * sum(rows) + columns * sum(rows[: self.num_viewed]))
        if gib > max_gib:
            raise ValueError(
                f"resolutions {list(resolutions)} need {gib:.1f} GiB in training, with gradients, moments "
                f"and copies, of max_gib={max_gib:g}: use coarser ones, a lower view_resolution, or raise max_gib"
            )
        self.levels = tuple(GridLevels.dense([level]) for level in cells)
        self.density_activation, self.density_shift = density_activation, density_shift
        self.density_scale = density_scale
        self.window_end = window_end
        self.window = nn.Buffer(torch.ones(len(rows)), persistent=window_end is not None)
        self.num_open = len(rows)  # levels that are evaluated; the others' window is zero
        self.low = nn.Buffer(corners[0], persistent=False)
        self.scale = nn.Buffer(1 / (corners[1] - corners[0]), persistent=False)
        self.tables = nn.ParameterList(nn.Parameter(torch.zeros(n, 4)) for n in rows)
        self.harmonics = nn.ParameterList(nn.Parameter(torch.zeros(n, columns)) for n in rows[: self.num_viewed])

    def parameter_groups(self) -> list[ParameterGroup]:
        """Densities and constant colours in "voxels", the other harmonics in "voxels_view"."""
        return [ParameterGroup("voxels", tuple(self.tables)), ParameterGroup("voxels_view", tuple(self.harmonics))]

    def set_progress(self, progress: float) -> None:
        """Open the window to where training stands, `progress` in [0, 1]; no effect without a window."""
        if self.window_end is None:
            return
        open_levels(self.window, progress / self.window_end)
        if not self.window.is_cuda:  # graphs that replay steps would go on without a level that has opened since
            self.num_open = min(len(self.window), 1 + math.ceil((len(self.window) - 1) * progress / self.window_end))

    def _summed(self, unit: Tensor, tables: nn.ParameterList) -> Tensor:
        """Values (N, F) at places (N, 3) of the unit cube: of all open levels, each times its share."""
        total: Tensor | None = None
        for number, (table, levels) in enumerate(zip(tables[: self.num_open], self.levels)):
            values = grid_encode(unit, table, levels)
            if self.window_end is not None:
                values = values * self.window[number].to(values.dtype)
            total = values if total is None else total + values
        assert total is not None
        return total

    def _activated(self, raw: Tensor) -> Tensor:
        return activate_density(raw * self.density_scale, self.density_activation, self.density_shift)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at canonical positions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        unit = in_unit_cube(positions, self.low, self.scale)
        return self._activated(self._summed(unit, self.tables)[:, 0]).reshape(times.shape)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at canonical positions (..., 3), directions (..., 3) and times (...,)."""
        check_positions_times(positions, times)
        unit = in_unit_cube(positions, self.low, self.scale)
        values = self._summed(unit, self.tables)
        density, colors = self._activated(values[:, 0]), values[:, 1:]
        if self.num_viewed:
            check_shape("directions", directions, positions.shape)
            basis = spherical_harmonics(directions.reshape(-1, 3), self.view_degree)[:, None, 1:] * VIEW_SCALE
            terms = self._summed(unit, self.harmonics).unflatten(1, (3, -1))
            colors = colors + (terms * basis).sum(2)
        return FieldOutput(density.reshape(times.shape), torch.sigmoid(colors).reshape(positions.shape))

    def roughness(self, turn: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Mean squared differences of neighbours, of all open tables, and zero: nothing changes with time.

        Of large tables at some neighbouring layers, others at every turn.
        """
        total = self.low.new_zeros(())
        for tables in (self.tables, self.harmonics):
            for table, levels in zip(tables[: self.num_open], self.levels):
                x, y, z = levels.cells
                count = min(LAYERS, z + 1)
                layers = turn * STRIDE % (z + 2 - count) + torch.arange(count, device=table.device)
                values = table.view(z + 1, y + 1, x + 1, -1).index_select(0, layers)
                total = total + sum(values.diff(dim=axis).square().mean() for axis in range(3))
        return total, torch.zeros_like(total)
