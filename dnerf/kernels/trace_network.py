"""Rendering rays of one time through a lattice of displacements and a network on a grid's features."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_positive, check_shape, check_whole
from dnerf.core.spherical_harmonics import spherical_harmonics

from .backend import run_compiled
from .checks import check_cells, check_shapes
from .grid_encode import GridLevels, check_grid, grid_encode_reference
from .grid_network import grid_network_reference, is_fused
from .march import kept_intervals
from .shade import shade_reference
from .skip_distances import blocks_shape

NUM_STATES = 5  # of a ray: transmittance, sums of rgb, sum of distances


@dataclass(frozen=True)
class FrameTables:
    """What `trace_network` looks rays up in: a scene at one time.

    Args:
        occupancy: (Gx, Gy, Gz) bool, cells in which samples are taken.
        skips, aabb: `skip_distances` of it, (ceil(Gx / 8), ...) uint8, and the box (2, 3) that it fills, world units.
        displacements: (V, 4), of the vertices of a lattice, in world units, x fastest, NaN where they are not known;
            the fourth number is ignored.
        is_known: (Lz + 1, Ly + 1, Lx + 1) bool, the vertices of which they are known; V in all.
        low, sides: (3,) lowest corner and sides of that lattice, in world units.
        field_low, field_scale: (3,) lowest corner of the grid's box, in canonical space, and one by its sides.
        table, levels, weights, biases: see `grid_network`; of 1 + 3 (degree + 1)^2 outputs: density, then, for red,
            green and blue in turn, coefficients of spherical harmonics.
        shifts: added to the network's outputs: the logarithm of density, and coefficients of colours before a sigmoid.

    Raises:
        ValueError: a shape or dtype that does not fit.
    """

    occupancy: Tensor
    skips: Tensor
    aabb: Tensor
    displacements: Tensor
    is_known: Tensor
    low: Tensor
    sides: Tensor
    field_low: Tensor
    field_scale: Tensor
    table: Tensor
    shifts: Tensor
    levels: GridLevels
    weights: list[Tensor]
    biases: list[Tensor]

    def __post_init__(self) -> None:
        check_cells("occupancy", self.occupancy, "Gx, Gy, Gz", least=1)
        check_cells("is_known", self.is_known, "Lz + 1, Ly + 1, Lx + 1", least=2)
        check_shape("skips", self.skips, blocks_shape(self.occupancy[None])[1:])
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("low", "sides", "field_low", "field_scale"), (3,))
        shapes |= {"aabb": (2, 3), "displacements": (self.is_known.numel(), 4)}
        shapes |= {"shifts": (1 + 3 * (self.degree + 1) ** 2,)}
        for name, shape in shapes.items():
            check_shape(name, getattr(self, name), shape)
            if getattr(self, name).dtype != torch.float32:
                raise ValueError(f"{name} must be float32, got {getattr(self, name).dtype}")
        check_grid(self.table[:0, :1].expand(0, 3), self.table, self.levels)

    @property
    def degree(self) -> int:
        """Of the harmonics; ValueError if that many outputs are not those of any."""
        num_outputs = len(self.weights[-1]) if len(self.weights) > 1 else 0
        degree = math.isqrt(max(num_outputs - 1, 0) // 3) - 1
        if num_outputs != 1 + 3 * (degree + 1) ** 2 or degree < 0:
            raise ValueError(
                "weights must be of at least two layers, the last one with 1 + 3 (degree + 1)^2 outputs, got "
                f"{len(self.weights)} layers with {num_outputs}"
            )
        return degree


def is_traced(positions: Tensor, in_features: int, weights: Sequence[Tensor]) -> bool:
    """Whether `trace_network` has a kernel for such networks, in the precision and on the processor of now."""
    return is_fused(positions, in_features, weights, beside_tiles=True)


@torch.no_grad()
def trace_network(
    origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, tables: FrameTables, *, step: float,
    subdivision: int, min_weight: float, subdivision_weight: float, stop_transmittance: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Follow rays front to back through the intervals of `march` (jitter 0), evaluating a network, to their end.

    Of an interval's middle x, the displacement d(x) is interpolated; `grid_network` at x + d(x) gives a, and b_k of
    each colour: density `exp(min(a, 15))`, colour `sigmoid(sum_k Y_k b_k)`, with `spherical_harmonics` Y of the ray's
    direction. If intervals are cut, those whose weight does not exceed `min_weight` are left out, those up to
    `subdivision_weight` are composited whole, and the parts of all others are. Nothing is evaluated behind the end of a
    ray. Not differentiable.

    Args:
        origins, directions, near, far: of R rays, see `march`.
        tables: the scene at the rays' time.
        step: length of an interval, in world units.
        subdivision: parts of an interval; 1 leaves all whole.
        min_weight, subdivision_weight: see above; without effect if intervals are not cut.
        stop_transmittance: a ray ends once so little light is left.

    Returns:
        (R, 5) of each ray: transmittance, then sums over weights of rgb and of the distance; and of which rays (R,)
        that is true: not of those that left the lattice or came to where it is not known.

    Raises:
        ValueError: shapes that do not fit each other.
    """
    each = origins.shape[:1]
    check_shapes(origins=(origins, (*each, 3)), directions=(directions, (*each, 3)), near=(near, each), far=(far, each))
    check_positive("step", step)
    check_whole("subdivision", subdivision)
    rays = [x.float() for x in (origins, directions, near, far)]
    scalars = [float(x) for x in (step, min_weight, subdivision_weight, stop_transmittance)]
    if tables.table.dtype == torch.float32 and is_traced(rays[0], tables.weights[0].shape[1], tables.weights):
        basis = spherical_harmonics(rays[1], tables.degree)
        return run_compiled("trace_network", "trace_network", basis, rays, tables, subdivision, scalars)
    return trace_network_reference(rays, tables, subdivision, scalars)


def trace_network_reference(
    rays: list[Tensor], tables: FrameTables, subdivision: int, scalars: list[float]
) -> tuple[Tensor, Tensor]:
    """The definition of `trace_network` in plain torch: all rays, one interval after the other."""
    origins, directions, near, _ = rays
    step, min_weight, subdivision_weight, stop_transmittance = scalars
    still = torch.zeros_like(near)
    starts, ends, keep = kept_intervals((*rays, still, still), tables.occupancy[None], tables.aabb, step)
    states = torch.zeros(len(origins), NUM_STATES, device=near.device)
    states[:, 0] = 1
    is_done, goes_on = (torch.ones(len(origins), dtype=torch.bool, device=near.device) for _ in range(2))

    shape, basis = tables.is_known.shape, spherical_harmonics(directions, tables.degree)
    levels = GridLevels.dense([[length - 1 for length in reversed(shape)]])

    def ask(chosen: Tensor, middles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Densities and colours of chosen rays (n,) at distances, and whether they are known."""
        places = origins[chosen] + middles[:, None] * directions[chosen]
        lattice = (places - tables.low) / tables.sides
        places = places + grid_encode_reference(lattice, tables.displacements[:, :3], levels)
        places[~((lattice >= 0) & (lattice <= 1)).all(-1)] = torch.nan
        unit = (places - tables.field_low) * tables.field_scale
        raw = grid_network_reference(unit, tables.table, tables.levels, tables.weights, tables.biases).float()
        density, colors = (raw + tables.shifts).tensor_split([1], dim=-1)
        seen = (colors.unflatten(-1, (3, -1)) * basis[chosen, None]).sum(-1)
        return *shade_reference(torch.cat([density, seen], dim=-1), raw.new_zeros(4), 0.0), places.isfinite().all(-1)

    def add(chosen: Tensor, density: Tensor, rgb: Tensor, middles: Tensor, lengths: Tensor) -> None:
        opacity, light = -torch.expm1(-density * lengths), states[chosen, 0]
        states[chosen, 1:] += (light * opacity)[:, None] * torch.cat([rgb, middles[:, None]], dim=-1)
        states[chosen, 0] = light * (1 - opacity)

    for j in range(keep.shape[1]):
        chosen = (goes_on & keep[:, j]).nonzero()[:, 0]
        first, lengths = starts[chosen, j], ends[chosen, j] - starts[chosen, j]
        middles = 0.5 * (first + ends[chosen, j])
        density, rgb, is_known = ask(chosen, middles)
        weights = states[chosen, 0] * -torch.expm1(-density * lengths)
        is_whole = (weights > min_weight) & (weights <= subdivision_weight) | (subdivision == 1)
        is_cut = is_known & ~is_whole & ~(weights <= min_weight)  # NaN is seen
        is_whole &= is_known
        add(chosen[is_whole], density[is_whole], rgb[is_whole], middles[is_whole], lengths[is_whole])
        is_done[chosen[~is_known]] = False
        for k in range(subdivision):
            part = lengths[is_cut] / subdivision
            middle = first[is_cut] + (k + 0.5) * part
            density, rgb, is_known = ask(chosen[is_cut], middle)
            is_done[chosen[is_cut][~is_known]] = False
            add(chosen[is_cut], density, rgb, middle, part)
        goes_on &= is_done & (states[:, 0] > stop_transmittance)
    return states, is_done
