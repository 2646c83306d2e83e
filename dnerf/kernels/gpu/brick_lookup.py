# mypy: disallow_untyped_defs=False, disallow_incomplete_defs=False
"""Triton version of `brick_lookup`."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..brick_lookup import BRICK, VERTICES

BLOCK = 128
SIDE = tl.constexpr(BRICK + 1)
CELLS = tl.constexpr(BRICK)
ROWS = tl.constexpr(VERTICES)


def brick_lookup(positions: Tensor, slots: Tensor, bricks: Tensor) -> tuple[Tensor, Tensor]:
    count, num_features = positions.shape[0], bricks.shape[2]
    values = positions.new_empty(count, num_features)
    known = torch.empty(count, dtype=torch.bool, device=bricks.device)
    if count:
        _lookup[(triton.cdiv(count, BLOCK),)](
            positions.contiguous(),
            slots.contiguous(),
            bricks.contiguous(),
            values,
            known,
            count,
            *slots.shape,
            num_features,
            triton.next_power_of_2(num_features),
            BLOCK,
        )
    return values, known


@triton.jit
def _locate(positions, samples, valid, num_bricks, axis: tl.constexpr):
    """Whether a position is in the lattice on one axis (a NaN is not), its cell and its place there."""
    position = tl.load(positions + samples * 3 + axis, valid, 0.0)
    cells = num_bricks * CELLS
    inside = (position >= 0) & (position <= cells)
    safe = tl.where(inside, position, 0.0).to(position.dtype)
    cell = tl.minimum(safe.to(tl.int64), cells - 1)
    return inside, cell, safe - cell.to(position.dtype)


@triton.jit
def _lookup(
    positions,
    slots,
    bricks,
    values,
    known,
    count,
    bx,
    by,
    bz,
    num_features: tl.constexpr,
    width: tl.constexpr,
    block: tl.constexpr,
):
    samples = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    features = tl.arange(0, width)
    valid = samples < count
    in_x, x, u = _locate(positions, samples, valid, bx, 0)
    in_y, y, v = _locate(positions, samples, valid, by, 1)
    in_z, z, w = _locate(positions, samples, valid, bz, 2)
    number = tl.load(slots + (x // CELLS * by + y // CELLS) * bz + z // CELLS, valid, -1)
    is_known = in_x & in_y & in_z & (number >= 0)
    mask = valid[:, None] & is_known[:, None] & (features < num_features)[None, :]
    first = number * ROWS + (x % CELLS * SIDE + y % CELLS) * SIDE + z % CELLS
    total = tl.zeros((block, width), values.dtype.element_ty)
    for k in tl.static_range(8):
        weights = (u if k & 4 else 1 - u) * (v if k & 2 else 1 - v) * (w if k & 1 else 1 - w)
        rows = first + (k >> 2) * SIDE * SIDE + (k >> 1 & 1) * SIDE + (k & 1)
        total += weights[:, None] * tl.load(bricks + rows[:, None] * num_features + features[None, :], mask, 0.0)
    out = valid[:, None] & (features < num_features)[None, :]
    tl.store(values + samples[:, None] * num_features + features[None, :], total, out)
    tl.store(known + samples, is_known, valid)
