"""Trilinear lookup in a lattice of which only some bricks exist."""

import torch
from torch import Tensor

from dnerf.geometry import cube_corners

from .backend import choose, run_compiled
from .op import op

BRICK_BITS = 3
BRICK = 1 << BRICK_BITS
VERTICES = (BRICK + 1) ** 3


@torch.no_grad()
def brick_lookup(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate, at the given positions, the values that bricks of 8 x 8 x 8 cells hold at their vertices.

    The lattice has 8 Bx x 8 By x 8 Bz cells of side 1. Each brick has 9 x 9 x 9 vertices of its own, z fastest, so that
    its faces' are kept twice. Not differentiable.

    Args:
        positions: (N, 3) in cells, from the lattice's low corner; on the face between two bricks the upper one counts.
        slots: (Bx, By, Bz) int64, number of the brick that is there, or -1.
        bricks: (M, 729, F) values, float16, float32 or float64.

    Returns:
        values (N, F) in the dtype of `bricks`, or float32 for float16, 0 where nothing is known, and whether
        they are known (N,) bool: the position is inside the lattice and its brick exists.

    Raises:
        ValueError: a shape or dtype that does not fit.
    """
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions must have shape (N, 3), got {tuple(positions.shape)}")
    if slots.ndim != 3 or slots.dtype != torch.int64:
        raise ValueError(f"slots must be int64 of shape (Bx, By, Bz), got {slots.dtype} {tuple(slots.shape)}")
    if bricks.ndim != 3 or bricks.shape[1] != VERTICES:
        raise ValueError(f"bricks must have shape (M, {VERTICES}, F), got {tuple(bricks.shape)}")
    if bricks.dtype not in (torch.float16, torch.float32, torch.float64):
        raise ValueError(f"bricks must be float16, float32 or float64, got {bricks.dtype}")
    positions = positions.to(torch.promote_types(bricks.dtype, torch.float32))
    if choose(positions) == "reference":
        return brick_lookup_reference(positions, slots, bricks)
    return torch.ops.dnerf.brick_lookup(positions, slots, bricks)


def brick_lookup_reference(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    """The definition of `brick_lookup` in plain torch."""
    if not len(bricks):
        return positions.new_zeros(len(positions), bricks.shape[2]), torch.zeros_like(positions[:, 0], dtype=torch.bool)
    shape = torch.tensor(slots.shape, device=slots.device)
    inside = ((positions >= 0) & (positions <= shape * BRICK)).all(-1)
    safe = torch.where(inside[:, None], positions, 0)
    cells = safe.long().clamp(max=shape * BRICK - 1)
    number = slots[(cells // BRICK).unbind(-1)]
    known = inside & (number >= 0)
    fraction = (safe - cells)[:, None]
    corners = cube_corners(slots.device)
    weights = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
    x, y, z = (cells[:, None] % BRICK + corners).unbind(-1)
    side = BRICK + 1
    values = bricks.flatten(0, 1)[number.clamp(min=0)[:, None] * VERTICES + (x * side + y) * side + z]
    return torch.where(known[:, None], (weights[..., None] * values).sum(1), 0), known


@op("dnerf::brick_lookup")
def _brick_lookup(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    return run_compiled("brick_lookup", "brick_lookup", positions, slots, bricks)


@_brick_lookup.register_fake
def _(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    count = positions.shape[0]
    return positions.new_empty(count, bricks.shape[2]), positions.new_empty(count, dtype=torch.bool)
