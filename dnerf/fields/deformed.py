"""A canonical field seen through a deformation: every dynamic model of the package."""

from dataclasses import replace

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.shortcuts import speaks_for
from dnerf.deformations import CachedAtTime, Deformation
from dnerf.deformations.base import deformation_at_time
from dnerf.fields.base import FrameTabled, NetworkTabled, NetworkTables, RadianceField, field_at_time
from dnerf.kernels import FrameTables, MarchGrid, is_traced


class DeformedField(RadianceField):
    """The canonical field at deformed positions: (density, rgb)(x, d, t) = canonical(deformation(x, t), d, t).

    Viewing directions are not turned by the deformation (as in D-NeRF). Its output carries the extras
    "canonical_positions" (..., 3), "positions" (..., 3) and "times" (...,) as they came.

    Args:
        deformation: world -> canonical.
        canonical: field in canonical space; it may use the time as well.
    """

    def __init__(self, deformation: Deformation, canonical: RadianceField) -> None:
        super().__init__()
        self.deformation = deformation
        self.canonical = canonical

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at positions (..., 3) and times (...,)."""
        return self.canonical.density(self.deformation(positions, times), times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions (..., 3), directions (..., 3) and times (...,)."""
        canonical_positions = self.deformation(positions, times)
        output = self.canonical(canonical_positions, directions, times)
        extras = {"canonical_positions": canonical_positions, "positions": positions, "times": times}
        return replace(output, extras={**output.extras, **extras})

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same with both parts at that time."""
        deformation = deformation_at_time(self.deformation, time, extent)
        canonical = field_at_time(self.canonical, time)
        if deformation is self.deformation and canonical is self.canonical:
            return self
        made = CachedField if isinstance(deformation, CachedAtTime) else DeformedField
        field = made(deformation, canonical)
        field.training = self.training  # its parts, which may be shared, keep theirs
        return field


class CachedField(DeformedField, FrameTabled):
    """A deformed field at one time whose displacements are kept on a lattice, see `CachedAtTime`."""

    deformation: CachedAtTime

    def frame_tables(self, grid: MarchGrid, num_rays: int) -> FrameTables | None:
        """See `FrameTabled`; None too where rays will need few of all displacements around occupied cells."""
        canonical, lattice = self.canonical, self.deformation
        is_filled = lattice.fill_around(grid, num_rays)  # at once is quicker for the generic path, too
        if not isinstance(canonical, NetworkTabled) or not speaks_for(canonical, "network_tables", "forward"):
            return None
        network = canonical.network_tables()
        if not is_filled or network is None or not _is_served(network, grid):
            return None
        return FrameTables(
            occupancy=grid.occupancy, skips=grid.skips, aabb=grid.aabb, displacements=lattice.displacements,
            is_known=lattice.is_known, low=lattice.low, sides=lattice.sides, field_low=network.low,
            field_scale=network.scale, table=network.table, shifts=network.shifts, levels=network.levels,
            weights=network.weights, biases=network.biases,
        )  # fmt: skip


def _is_served(network: NetworkTables, grid: MarchGrid) -> bool:
    tensors = (network.table, network.low, network.shifts, grid.aabb)
    is_single = all(tensor.dtype == torch.float32 for tensor in tensors)
    return is_single and is_traced(network.table, network.weights[0].shape[1], network.weights)
