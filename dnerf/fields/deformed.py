"""A canonical field seen through a deformation: every dynamic model of the package."""

from dataclasses import replace

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.shortcuts import speaks_for
from dnerf.deformations import CachedAtTime, Deformation
from dnerf.deformations.base import deformation_at_time, unwrapped
from dnerf.fields.base import (
    FrameTabled,
    IntervalAware,
    NetworkTabled,
    RadianceField,
    SignedDistance,
    ends_of,
    field_at_time,
    interval_aware,
    surface_of,
    warn_of_generic_path,
)
from dnerf.kernels import FrameTables, MarchGrid, get_backend, is_traced


class DeformedField(RadianceField, IntervalAware, SignedDistance):
    """The canonical field at deformed positions: (density, rgb)(x, d, t) = canonical(deformation(x, t), d, t).

    Viewing directions are not turned by the deformation (as in D-NeRF). Its output carries the extras
    "canonical_positions" (..., 3), "positions" (..., 3) and "times" (...,) as they came. It knows intervals and has a
    surface if the canonical field does; its distance is the canonical one.

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

    @property
    def knows_intervals(self) -> bool:
        """Whether the canonical field does."""
        return interval_aware(self.canonical) is not None

    @property
    def has_surface(self) -> bool:
        """Whether the canonical field has one."""
        return surface_of(self.canonical) is not None

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """The canonical field's distance (...,) at positions (..., 3), which need not lie on rays, and times (...,)."""
        surface = surface_of(self.canonical)
        assert surface is not None, "called only if has_surface"
        return surface.distance(unwrapped(self.deformation)(positions, times), times)

    def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """What the canonical field says of the straight interval between where both ends go, per unit of length here.

        The extra "canonical_positions" is the middle of that interval.
        """
        canonical = interval_aware(self.canonical)
        assert canonical is not None, "called only if knows_intervals"
        all_ends = ends_of(starts, ends, directions, times)
        first, last = all_ends.pairs(self.deformation(all_ends.positions, all_ends.times))
        output = canonical.between(first, last, directions, times)
        length = (ends - starts).norm(dim=-1)
        is_long = length > 0
        share = torch.where(is_long, (last - first).norm(dim=-1) / torch.where(is_long, length, 1), 1)
        extras = {"canonical_positions": 0.5 * (first + last), "positions": 0.5 * (starts + ends), "times": times}
        return replace(output, density=output.density * share, extras={**output.extras, **extras})

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same with both parts at that time."""
        deformation = deformation_at_time(self.deformation, time, extent)
        canonical = field_at_time(self.canonical, time)
        if deformation is self.deformation and canonical is self.canonical:
            return self
        made = CachedField if isinstance(deformation, CachedAtTime) else DeformedField
        field = (StillField if deformation.is_identity else made)(deformation, canonical)
        field.training = self.training  # its parts, which may be shared, keep theirs
        return field


class CachedField(DeformedField, FrameTabled):
    """A deformed field at one time whose displacements are kept on a lattice, see `CachedAtTime`."""

    deformation: CachedAtTime

    def frame_tables(self, grid: MarchGrid, num_rays: int) -> FrameTables | None:
        """See `FrameTabled`; None too where rays will need few of all displacements around occupied cells."""
        lattice = self.deformation
        if not lattice.fill_around(grid, num_rays):  # at once is quicker for the generic path, too
            return None
        return _frame_tables(
            self.canonical, grid, displacements=lattice.displacements, is_known=lattice.is_known, low=lattice.low,
            sides=lattice.sides,
        )  # fmt: skip


class StillField(DeformedField, FrameTabled):
    """A field at one time that nothing moves: displacements are zero in one cell around the occupied ones."""

    def frame_tables(self, grid: MarchGrid, num_rays: int) -> FrameTables | None:
        """See `FrameTabled`."""
        low, high = grid.aabb[0] - grid.step, grid.aabb[1] + grid.step  # intervals reach out of cells
        return _frame_tables(
            self.canonical, grid, displacements=low.new_zeros(8, 4),
            is_known=torch.ones(2, 2, 2, dtype=torch.bool, device=low.device), low=low, sides=high - low,
        )  # fmt: skip


def _frame_tables(canonical: RadianceField, grid: MarchGrid, **lattice: Tensor) -> FrameTables | None:
    """Of a field in canonical space behind a lattice of displacements."""
    if not grid.aabb.is_cpu or get_backend() == "reference":
        return None
    if not isinstance(canonical, NetworkTabled) or not speaks_for(canonical, "network_tables", "forward"):
        return warn_of_generic_path(f"a canonical {type(canonical).__name__}")
    network = canonical.network_tables()
    if network is None or any(x.dtype != torch.float32 for x in (network.table, network.low, network.shifts)):
        return None
    if not is_traced(network.table, network.weights[0].shape[1], network.weights):
        widths = [network.weights[0].shape[1], *map(len, network.weights)]
        return warn_of_generic_path(f"layers of widths {widths} here: hidden ones in multiples of 16")
    return FrameTables(
        occupancy=grid.occupancy, skips=grid.skips, aabb=grid.aabb, field_low=network.low, field_scale=network.scale,
        table=network.table, shifts=network.shifts, levels=network.levels, weights=network.weights,
        biases=network.biases, **lattice,
    )  # fmt: skip
