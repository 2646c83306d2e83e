"""Rendering rays of one time through lattices: march, displace, look up and composite, ray by ray."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from dnerf.geometry import cube_corners

from .backend import choose, run_compiled
from .brick_lookup import BRICK, VERTICES, brick_lookup_reference
from .grid_encode import GridLevels, grid_encode_reference
from .march import kept_intervals
from .op import op
from .shade import MOST_LOG_DENSITY
from .skip_distances import blocks_shape

DONE, ELSEWHERE = -1, -2
LACKS_VERTEX, LACKS_BRICK = 1, 2
LOOK_AHEAD = 8  # kept intervals of a waiting ray whose vertices are asked for at once
NUM_STATES = 5


@dataclass(frozen=True)
class FrameTables:
    """What `trace` looks rays up in: a scene at one time.

    Args:
        occupancy: (Gx, Gy, Gz) bool, cells in which samples are taken.
        skips: (ceil(Gx / 8), ...) uint8, `skip_distances` of it.
        aabb: (2, 3) box that the cells fill, in world units.
        displacements: (V, 4) or (V, 8), of the vertices of a lattice, in world units, x fastest, NaN where they are not
            known; the fourth number is ignored. The last four, if there are eight, are what is added to the sums of
            terms of the logarithm of density, of red, green and blue.
        is_known: (Lz + 1, Ly + 1, Lx + 1) bool, the vertices of which they are known; V in all.
        low: (3,) lowest corner of that lattice, in world units.
        sides: (3,) of it.
        slots: (Bx, By, Bz) int64, see `brick_lookup`.
        bricks: (M, 729, 4 K), float32 or float16: a place's terms of the logarithm of density, then of red, green and
            blue.
        brick_low: (3,) lowest corner of the bricks, in canonical space.
        waves: (K,) factors of the terms at this time.

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
    slots: Tensor
    bricks: Tensor
    brick_low: Tensor
    waves: Tensor

    def __post_init__(self) -> None:
        for name in ("occupancy", "is_known"):
            value, least = getattr(self, name), 1 + (name == "is_known")
            if value.ndim != 3 or value.dtype != torch.bool or min(value.shape) < least:
                raise ValueError(
                    f"{name} must be bool of three axes of at least {least}, got {value.dtype} {tuple(value.shape)}"
                )
        shapes = {
            "skips": blocks_shape(self.occupancy[None])[1:],
            "aabb": (2, 3),
            "displacements": (self.is_known.numel(), 8 if self.displacements.shape[-1:] == (8,) else 4),
            "low": (3,),
            "sides": (3,),
            "bricks": (len(self.bricks), VERTICES, 4 * len(self.waves)),
            "brick_low": (3,),
            "waves": (self.waves.numel(),),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {tuple(getattr(self, name).shape)}")
        if self.slots.ndim != 3 or self.slots.dtype != torch.int64 or not self.slots.numel():
            raise ValueError(f"slots must be int64 of three axes, got {self.slots.dtype} {tuple(self.slots.shape)}")
        for name in ("aabb", "displacements", "low", "sides", "brick_low", "waves"):
            if getattr(self, name).dtype != torch.float32:
                raise ValueError(f"{name} must be float32, got {getattr(self, name).dtype}")
        if self.bricks.dtype not in (torch.float32, torch.float16):
            raise ValueError(f"bricks must be float32 or float16, got {self.bricks.dtype}")

    def tensors(self) -> list[Tensor]:
        """All of them, in the order of the arguments."""
        return [getattr(self, field.name) for field in fields(self)]


@torch.no_grad()
def trace(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    states: Tensor,
    numbers: Tensor,
    tables: FrameTables,
    *,
    step: float,
    splits: int,
    min_weight: float,
    split_weight: float,
    cells_per_unit: float,
    log_shift: float,
    stop_transmittance: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Follow rays front to back through the intervals of `march` (jitter 0), as far as what they need is known.

    Of an interval's middle x, the displacement d(x) is interpolated, then the contents at x + d(x), whose terms times
    `waves` sum up, with what the lattice adds at x, to a, b_1, b_2, b_3: density `exp(min(a + log_shift, 15))`, colour
    `sigmoid(b)`. They are composited as `composite` does; if intervals are split, those whose weight does not exceed
    `min_weight` are left out, those up to `split_weight` are composited whole, and the parts of all others are. A ray
    that needs a vertex or brick that is not known waits at that interval. Not differentiable. It is the chain march,
    grid_encode, brick_lookup, composite without anything written in between.

    Args:
        origins: (R, 3), world units.
        directions: (R, 3), unit norm.
        near, far: (R,) range of distances.
        states: (R, 5) of each ray so far: transmittance, then sums over weights of rgb and of the distance; a fresh
            ray has 1, 0, 0, 0, 0.
        numbers: (R,) int64, each ray's next interval, counted from its first possible one: 0 for a fresh ray, or what
            came back. Rays with negative numbers are left alone.
        tables: the scene at the rays' time.
        step: length of an interval, in world units.
        splits: parts of an interval.
        min_weight: see above; without effect if intervals are not split.
        split_weight: likewise.
        cells_per_unit: of the bricks' lattice.
        log_shift: added to the logarithm of density.
        stop_transmittance: a ray ends once so little light is left.

    Returns:
        states (R, 5); numbers (R,) with -1 for a ray that has ended and -2 for one that left the lattices, at a place
        that nothing here can know; which vertices (V,) are wanted: where a ray waits for one, all around that interval
        and the next ones that are not known; and which bricks (Bx, By, Bz) rays wait for.

    Raises:
        ValueError: shapes that do not fit each other.
    """
    num_rays = len(origins)
    shapes = {"origins": (num_rays, 3), "directions": (num_rays, 3), "near": (num_rays,), "far": (num_rays,)}
    shapes |= {"states": (num_rays, NUM_STATES), "numbers": (num_rays,)}
    given = {"origins": origins, "directions": directions, "near": near, "far": far}
    for name, value in (given | {"states": states, "numbers": numbers}).items():
        if value.shape != shapes[name]:
            raise ValueError(f"{name} must have shape {shapes[name]}, got {tuple(value.shape)}")
    for name, number in (("step", step), ("splits", splits)):
        if not number > 0:
            raise ValueError(f"{name} must be positive, got {number}")
    rays = [x.float() for x in (origins, directions, near, far, states)]
    scalars = [float(x) for x in (step, min_weight, split_weight, cells_per_unit, log_shift, stop_transmittance)]
    arguments = (numbers, rays, tables.tensors(), splits, scalars)
    return torch.ops.dnerf.trace(*arguments) if choose(rays[0]) == "numba" else trace_reference(*arguments)


def trace_reference(
    numbers: Tensor, rays: list[Tensor], tables: list[Tensor], splits: int, scalars: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The definition of `trace` in plain torch: all rays, one interval after the other.

    Args:
        numbers: see `trace`.
        rays: origins, directions, near, far, states.
        tables: those of `FrameTables`, in their order.
        splits: see `trace`.
        scalars: step, min_weight, split_weight, cells_per_unit, log_shift, stop_transmittance.
    """
    origins, directions, near, far, states = rays
    occupancy, _, aabb, displacements, is_known, low, sides, slots, bricks, brick_low, waves = tables
    step, min_weight, split_weight, cells_per_unit, log_shift, stop_transmittance = scalars
    still = torch.zeros_like(near)
    starts, ends, keep = kept_intervals(origins, directions, near, far, still, still, occupancy[None], aabb, step)
    states, numbers = states.clone(), numbers.clone()
    wanted, waits = torch.zeros_like(slots, dtype=torch.bool), torch.zeros_like(numbers, dtype=torch.bool)
    cells = [length - 1 for length in reversed(is_known.shape)]
    levels = GridLevels([cells], 1 << (is_known.numel() - 1).bit_length())
    shape = torch.tensor(slots.shape, device=near.device)

    def look(chosen: Tensor, middles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What chosen rays (n,) find at distances: sums (n, 4); whether, or why not (n,); and in which brick."""
        points = origins[chosen] + middles[:, None] * directions[chosen]
        unit = (points - low) / sides
        interpolated = grid_encode_reference(unit, displacements, levels)
        canonical = points + interpolated[:, :3]
        places = (canonical - brick_low) * cells_per_unit
        contents, is_found = brick_lookup_reference(places, slots, bricks)
        is_inside = ((places >= 0) & (places <= shape * BRICK)).all(-1)
        why = torch.where(is_found, 0, torch.where(is_inside, LACKS_BRICK, ELSEWHERE))
        why[canonical.isnan().any(-1)] = LACKS_VERTEX
        why[~((unit >= 0) & (unit <= 1)).all(-1)] = ELSEWHERE
        values = contents.unflatten(-1, (4, -1)) @ waves
        values = values + interpolated[:, 4:] if displacements.shape[1] > 4 else values
        return values, why, torch.minimum(places.nan_to_num().long() // BRICK, shape - 1)

    def stop(chosen: Tensor, why: Tensor, brick: Tensor) -> Tensor:
        """Let those rays wait or give up that lack something; which do not (n,)."""
        wanted[brick[why == LACKS_BRICK].unbind(-1)] = True
        numbers[chosen[why == ELSEWHERE]] = ELSEWHERE
        waits[chosen[why == LACKS_VERTEX]] = True
        goes_on[chosen[why != 0]] = False
        return why == 0

    def opacities(values: Tensor, lengths: Tensor) -> Tensor:
        return -torch.expm1(-torch.exp((values[:, 0] + log_shift).clamp(max=MOST_LOG_DENSITY)) * lengths)

    def add(chosen: Tensor, values: Tensor, middles: Tensor, lengths: Tensor) -> None:
        opacity, light = opacities(values, lengths), states[chosen, 0]
        seen = torch.cat([torch.sigmoid(values[:, 1:]), middles[:, None]], dim=-1)
        states[chosen, 1:] += (light * opacity)[:, None] * seen
        states[chosen, 0] = light * (1 - opacity)

    for j in range(keep.shape[1]):
        numbers[(numbers == j) & ~keep[:, j]] = j + 1
        goes_on = numbers == j
        chosen = goes_on.nonzero()[:, 0]
        first, lengths = starts[chosen, j], ends[chosen, j] - starts[chosen, j]
        values, why, brick = look(chosen, 0.5 * (first + ends[chosen, j]))
        able = stop(chosen, why, brick)
        chosen, values, first, lengths = chosen[able], values[able], first[able], lengths[able]
        weights = states[chosen, 0] * opacities(values, lengths)
        is_whole = (weights > min_weight) & (weights <= split_weight) if splits > 1 else torch.ones_like(able[able])
        add(chosen[is_whole], values[is_whole], (first + 0.5 * lengths)[is_whole], lengths[is_whole])
        able = ~is_whole & ~(weights <= min_weight)  # NaN is seen
        chosen, first, lengths = chosen[able], first[able], lengths[able] / splits
        if len(chosen):
            found = [look(chosen, first + (k + 0.5) * lengths) for k in range(splits)]
            why = torch.stack([why for _, why, _ in found])
            lacks = (why != 0).long().argmax(0)  # the first part that lacks something
            each = torch.arange(len(chosen), device=near.device)
            able = stop(chosen, why[lacks, each], torch.stack([brick for _, _, brick in found])[lacks, each])
            for k, (values, _, _) in enumerate(found):
                middles = first + (k + 0.5) * lengths
                add(chosen[able], values[able], middles[able], lengths[able])
        numbers[goes_on] = torch.where(states[goes_on, 0] > stop_transmittance, j + 1, DONE)
    numbers[(numbers >= 0) & (numbers >= keep.shape[1])] = DONE

    ahead = keep & waits[:, None] & (torch.arange(keep.shape[1], device=near.device) >= numbers[:, None])
    owners, columns = (ahead & (ahead.cumsum(-1) <= LOOK_AHEAD)).nonzero().unbind(-1)
    first, last = starts[owners, columns, None], ends[owners, columns, None]
    parts = torch.arange(splits, device=near.device) + 0.5
    middles = torch.cat([first + parts * ((last - first) / splits), 0.5 * (first + last)], dim=-1)
    points = origins[owners, None] + middles[..., None] * directions[owners, None]
    unit = ((points - low) / sides).reshape(-1, 3)
    unit = unit[((unit >= 0) & (unit <= 1)).all(-1)]
    size = torch.tensor(cells, device=near.device)
    x, y, z = (torch.minimum((unit * size).long(), size - 1)[:, None] + cube_corners(near.device)).unbind(-1)
    vertices = torch.zeros_like(is_known)
    vertices[z, y, x] = True
    return states, numbers, (vertices & ~is_known).reshape(-1), wanted


@op("dnerf::trace")
def _trace(
    numbers: Tensor, rays: list[Tensor], tables: list[Tensor], splits: int, scalars: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return run_compiled("trace", "trace", numbers, rays, tables, splits, scalars)


@_trace.register_fake
def _(
    numbers: Tensor, rays: list[Tensor], tables: list[Tensor], splits: int, scalars: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    is_known, slots = tables[4], tables[7]
    return (
        torch.empty_like(rays[4]),
        torch.empty_like(numbers),
        is_known.new_empty(is_known.numel()),
        torch.empty_like(slots, dtype=torch.bool),
    )
