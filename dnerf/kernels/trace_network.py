"""Rendering rays of one time through a lattice of displacements and a network on a grid's features."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .backend import run_compiled
from .grid_encode import GridLevels, check_grid
from .grid_network import grid_network_reference, is_fused
from .lattice_places import lattice_places_reference
from .march import kept_intervals
from .op import op
from .shade import shade_reference
from .skip_distances import blocks_shape
from .trace import NUM_STATES


@dataclass(frozen=True)
class NetworkTables:
    """What `trace_network` looks rays up in: a scene at one time.

    Args:
        occupancy: (Gx, Gy, Gz) bool, cells in which samples are taken.
        skips: (ceil(Gx / 8), ...) uint8, `skip_distances` of it.
        aabb: (2, 3) box that the cells fill, in world units.
        displacements: (V, 4), of the vertices of a lattice, in world units, x fastest, NaN where they are not known;
            the fourth number is ignored.
        is_known: (Lz + 1, Ly + 1, Lx + 1) bool, the vertices of which they are known; V in all.
        low: (3,) lowest corner of that lattice, in world units.
        sides: (3,) of it.
        field_low: (3,) lowest corner of the grid's box, in canonical space.
        field_scale: (3,) one by its sides.
        table: (T, F), see `grid_network`.
        shifts: (4,) added to the network's outputs: the logarithm of density, red, green and blue before a sigmoid.
        levels: of the grid.
        weights: see `grid_network`; of four outputs.
        biases: likewise.

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
        for name in ("occupancy", "is_known"):
            value, least = getattr(self, name), 1 + (name == "is_known")
            if value.ndim != 3 or value.dtype != torch.bool or min(value.shape) < least:
                raise ValueError(
                    f"{name} must be bool of three axes of at least {least}, got {value.dtype} {tuple(value.shape)}"
                )
        shapes = {
            "skips": blocks_shape(self.occupancy[None])[1:], "aabb": (2, 3), "low": (3,), "sides": (3,),
            "displacements": (self.is_known.numel(), 4), "field_low": (3,), "field_scale": (3,), "shifts": (4,),
        }  # fmt: skip
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {tuple(getattr(self, name).shape)}")
            if name != "skips" and getattr(self, name).dtype != torch.float32:
                raise ValueError(f"{name} must be float32, got {getattr(self, name).dtype}")
        check_grid(self.table[:0, :1].expand(0, 3), self.table, self.levels)
        if len(self.weights) < 2 or len(self.weights[-1]) != 4:
            raise ValueError("weights must be of at least two layers, the last one with four outputs")

    def tensors(self) -> list[Tensor]:
        """All but levels, weights and biases, in the order of the arguments."""
        return [
            self.occupancy, self.skips, self.aabb, self.displacements, self.is_known, self.low, self.sides,
            self.field_low, self.field_scale, self.table, self.shifts,
        ]  # fmt: skip


@torch.no_grad()
def trace_network(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    is_left: Tensor,
    tables: NetworkTables,
    *,
    step: float,
    splits: int,
    min_weight: float,
    split_weight: float,
    stop_transmittance: float,
) -> tuple[Tensor, Tensor]:
    """Follow rays front to back through the intervals of `march` (jitter 0), asking a network, to their end.

    It is `trace` with a network on a grid's features instead of bricks, and with all vertices known: of an interval's
    middle x, the displacement d(x) is interpolated, then `grid_network` is asked at x + d(x) for a, b_1, b_2, b_3:
    density `exp(min(a, 15))`, colour `sigmoid(b)`. If intervals are split, those whose weight does not exceed
    `min_weight` are left out, those up to `split_weight` are composited whole, and the parts of all others are. Nothing
    behind the end of a ray is asked. Not differentiable.

    Args:
        origins: (R, 3), world units.
        directions: (R, 3), unit norm.
        near, far: (R,) range of distances.
        is_left: (R,) bool, rays that are left alone.
        tables: the scene at the rays' time.
        step: length of an interval, in world units.
        splits: parts of an interval.
        min_weight: see above; without effect if intervals are not split.
        split_weight: likewise.
        stop_transmittance: a ray ends once so little light is left.

    Returns:
        (R, 5) of each ray: transmittance, then sums over weights of rgb and of the distance; and of which rays (R,)
        that is true: not of those left alone, nor of those that left the lattice or came to where it is not known.

    Raises:
        ValueError: shapes that do not fit each other.
    """
    num_rays = len(origins)
    shapes: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "origins": (origins, (num_rays, 3)), "directions": (directions, (num_rays, 3)), "near": (near, (num_rays,)),
        "far": (far, (num_rays,)), "is_left": (is_left, (num_rays,)),
    }  # fmt: skip
    for name, (value, shape) in shapes.items():
        if value.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(value.shape)}")
    for name, number in (("step", step), ("splits", splits)):
        if not number > 0:
            raise ValueError(f"{name} must be positive, got {number}")
    rays = [x.float() for x in (origins, directions, near, far)]
    scalars = [float(x) for x in (step, min_weight, split_weight, stop_transmittance)]
    levels, in_features = tables.levels, tables.weights[0].shape[1]
    if tables.table.dtype == torch.float32 and is_fused(rays[0], in_features, tables.weights):
        rounded = [[x.bfloat16() for x in parameters] for parameters in (tables.weights, tables.biases)]
        return torch.ops.dnerf.trace_network(
            is_left, rays, tables.tensors(), levels.cells, levels.max_rows, *rounded, splits, scalars
        )
    return trace_network_reference(is_left, rays, tables, splits, scalars)


def trace_network_reference(
    is_left: Tensor, rays: list[Tensor], tables: NetworkTables, splits: int, scalars: list[float]
) -> tuple[Tensor, Tensor]:
    """The definition of `trace_network` in plain torch: all rays, one interval after the other."""
    origins, directions, near, far = rays
    step, min_weight, split_weight, stop_transmittance = scalars
    still = torch.zeros_like(near)
    starts, ends, keep = kept_intervals(
        origins, directions, near, far, still, still, tables.occupancy[None], tables.aabb, step
    )
    states = torch.zeros(len(origins), NUM_STATES, device=near.device)
    states[:, 0] = 1
    is_done, goes_on = ~is_left, ~is_left

    def ask(chosen: Tensor, middles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Densities and colours of chosen rays (n,) at distances, and whether they are known."""
        places = lattice_places_reference(
            origins, directions, chosen, middles, tables.displacements, tables.is_known.shape, tables.low, tables.sides
        )
        unit = (places - tables.field_low) * tables.field_scale
        raw = grid_network_reference(unit, tables.table, tables.levels, tables.weights, tables.biases)
        return *shade_reference(raw.float(), tables.shifts, 0.0), places.isfinite().all(-1)

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
        is_whole = (weights > min_weight) & (weights <= split_weight) if splits > 1 else torch.ones_like(is_known)
        is_cut = is_known & ~is_whole & ~(weights <= min_weight)  # NaN is seen
        is_whole &= is_known
        add(chosen[is_whole], density[is_whole], rgb[is_whole], middles[is_whole], lengths[is_whole])
        is_done[chosen[~is_known]] = False
        for k in range(splits):
            part = lengths[is_cut] / splits
            middle = first[is_cut] + (k + 0.5) * part
            density, rgb, is_known = ask(chosen[is_cut], middle)
            is_done[chosen[is_cut][~is_known]] = False
            add(chosen[is_cut], density, rgb, middle, part)
        goes_on &= is_done & (states[:, 0] > stop_transmittance)
    return states, is_done


@op("dnerf::trace_network")
def _trace_network(
    is_left: Tensor,
    rays: list[Tensor],
    tables: list[Tensor],
    cells: list[int],
    max_rows: int,
    weights: list[Tensor],
    biases: list[Tensor],
    splits: int,
    scalars: list[float],
) -> tuple[Tensor, Tensor]:
    arguments: tuple[Any, ...] = (rays, tables, cells, max_rows, weights, biases, splits, scalars)
    return run_compiled("trace_network", "trace_network", is_left, *arguments)


@_trace_network.register_fake
def _(
    is_left: Tensor,
    rays: list[Tensor],
    tables: list[Tensor],
    cells: list[int],
    max_rows: int,
    weights: list[Tensor],
    biases: list[Tensor],
    splits: int,
    scalars: list[float],
) -> tuple[Tensor, Tensor]:
    return rays[0].new_empty(len(is_left), NUM_STATES), torch.empty_like(is_left)
