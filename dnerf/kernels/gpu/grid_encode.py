# mypy: disallow_untyped_defs=False, disallow_incomplete_defs=False
"""Triton versions of `grid_encode` and its gradients."""

from functools import lru_cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..grid_encode import HASH_PRIMES, GridLevels

BLOCK = 128
PRIME_Y = tl.constexpr(HASH_PRIMES[1])
PRIME_Z = tl.constexpr(HASH_PRIMES[2])


def forward(positions: Tensor, table: Tensor, cells: list[int], max_rows: int, rounded: bool) -> Tensor:
    num_samples, levels = len(positions), _levels(tuple(cells), max_rows, positions.device)
    out = table.new_empty((num_samples, len(levels) * table.shape[1]))
    if num_samples:
        tensors = positions.contiguous(), table.contiguous(), levels, out
        _forward[triton.cdiv(num_samples, BLOCK), len(levels)](*tensors, num_samples, *_widths(table))
    return out.bfloat16() if rounded else out


def grad_table(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    num_samples, levels = len(positions), _levels(tuple(cells), max_rows, positions.device)
    out = torch.zeros_like(table, memory_format=torch.contiguous_format)
    if num_samples:
        tensors = grad.contiguous(), positions.contiguous(), levels, out
        _grad_table[triton.cdiv(num_samples, BLOCK), len(levels)](*tensors, num_samples, *_widths(table))
    return out


def grad_positions(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    num_samples, levels = len(positions), _levels(tuple(cells), max_rows, positions.device)
    out = torch.empty_like(positions, memory_format=torch.contiguous_format)
    if num_samples:
        tensors = grad.contiguous(), positions.contiguous(), table.contiguous(), levels, out
        _grad_positions[(triton.cdiv(num_samples, BLOCK),)](*tensors, num_samples, len(levels), *_widths(table))
    return out


def _widths(table: Tensor) -> tuple[int, int, int]:
    """Constants of the kernels: features of a row, the power of two that holds them, and samples of a program."""
    return table.shape[1], triton.next_power_of_2(table.shape[1]), BLOCK


@lru_cache(maxsize=64)
def _levels(cells: tuple[int, ...], max_rows: int, device: torch.device) -> Tensor:
    triples = [cells[i : i + 3] for i in range(0, len(cells), 3)]
    return torch.tensor(GridLevels(triples, max_rows).describe(), device=device)


@triton.jit
def _locate(positions, samples, mask, levels, level, axis: tl.constexpr):
    """Lower vertex and fraction along one axis. A NaN gives vertex 0 and fraction NaN, never a wild index."""
    cells = tl.load(levels + level * 5 + axis)
    position = tl.load(positions + samples * 3 + axis, mask, 0.0)
    clamped = tl.where(position < 0, 0.0, tl.where(position > 1, 1.0, position)).to(position.dtype)
    scaled = clamped * cells.to(position.dtype)
    lower = tl.minimum(tl.where(scaled >= 0, scaled, 0.0).to(tl.int64), tl.maximum(cells - 1, 0))
    return lower, scaled - lower.to(position.dtype)


@triton.jit
def _row(x, y, z, levels, level):
    """Table row of a vertex."""
    cells_x, cells_y = tl.load(levels + level * 5), tl.load(levels + level * 5 + 1)
    offset, hash_mask = tl.load(levels + level * 5 + 3), tl.load(levels + level * 5 + 4)
    z = tl.minimum(z, tl.load(levels + level * 5 + 2))  # a plane has one vertex
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & hash_mask
    return offset + tl.where(hash_mask < 0, x + (cells_x + 1) * (y + (cells_y + 1) * z), hashed)


@triton.jit
def _forward(
    positions, table, levels, out, num_samples, num_features: tl.constexpr, width: tl.constexpr, block: tl.constexpr
):
    samples = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    level, num_levels = tl.program_id(1), tl.num_programs(1)
    features = tl.arange(0, width)
    valid = samples < num_samples
    mask = valid[:, None] & (features < num_features)[None, :]
    x, u = _locate(positions, samples, valid, levels, level, 0)
    y, v = _locate(positions, samples, valid, levels, level, 1)
    z, w = _locate(positions, samples, valid, levels, level, 2)
    total = tl.zeros((block, width), table.dtype.element_ty)
    for k in tl.static_range(8):
        weights = (u if k & 1 else 1 - u) * (v if k & 2 else 1 - v) * (w if k & 4 else 1 - w)
        rows = _row(x + (k & 1), y + (k >> 1 & 1), z + (k >> 2), levels, level)
        values = tl.load(table + rows[:, None] * num_features + features[None, :], mask, 0.0)
        total += weights[:, None] * values
    columns = level * num_features + features
    tl.store(out + samples[:, None] * (num_levels * num_features) + columns[None, :], total, mask)


@triton.jit
def _grad_table(
    grad, positions, levels, out, num_samples, num_features: tl.constexpr, width: tl.constexpr, block: tl.constexpr
):
    samples = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    level, num_levels = tl.program_id(1), tl.num_programs(1)
    features = tl.arange(0, width)
    valid = samples < num_samples
    mask = valid[:, None] & (features < num_features)[None, :]
    x, u = _locate(positions, samples, valid, levels, level, 0)
    y, v = _locate(positions, samples, valid, levels, level, 1)
    z, w = _locate(positions, samples, valid, levels, level, 2)
    columns = level * num_features + features
    gradients = tl.load(grad + samples[:, None] * (num_levels * num_features) + columns[None, :], mask, 0.0)
    for k in tl.static_range(8):
        weights = (u if k & 1 else 1 - u) * (v if k & 2 else 1 - v) * (w if k & 4 else 1 - w)
        rows = _row(x + (k & 1), y + (k >> 1 & 1), z + (k >> 2), levels, level)
        target = out + rows[:, None] * num_features + features[None, :]
        tl.atomic_add(target, weights[:, None] * gradients, mask, sem="relaxed")


@triton.jit
def _grad_positions(
    grad, positions, table, levels, out, num_samples, num_levels, num_features: tl.constexpr, width: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    samples = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    features = tl.arange(0, width)
    valid = samples < num_samples
    mask = valid[:, None] & (features < num_features)[None, :]
    grad_x = tl.zeros((block,), table.dtype.element_ty)
    grad_y = tl.zeros((block,), table.dtype.element_ty)
    grad_z = tl.zeros((block,), table.dtype.element_ty)
    for level in range(num_levels):
        x, u = _locate(positions, samples, valid, levels, level, 0)
        y, v = _locate(positions, samples, valid, levels, level, 1)
        z, w = _locate(positions, samples, valid, levels, level, 2)
        columns = level * num_features + features
        gradients = tl.load(grad + samples[:, None] * (num_levels * num_features) + columns[None, :], mask, 0.0)
        along_x, along_y, along_z = tl.zeros_like(grad_x), tl.zeros_like(grad_y), tl.zeros_like(grad_z)
        for k in tl.static_range(8):
            rows = _row(x + (k & 1), y + (k >> 1 & 1), z + (k >> 2), levels, level)
            values = tl.load(table + rows[:, None] * num_features + features[None, :], mask, 0.0)
            product = tl.sum(gradients * values, 1)
            a, b, c = u if k & 1 else 1 - u, v if k & 2 else 1 - v, w if k & 4 else 1 - w
            along_x += product * (b * c if k & 1 else -b * c)
            along_y += product * (a * c if k & 2 else -a * c)
            along_z += product * (a * b if k & 4 else -a * b)
        grad_x += along_x * tl.load(levels + level * 5).to(along_x.dtype)
        grad_y += along_y * tl.load(levels + level * 5 + 1).to(along_y.dtype)
        grad_z += along_z * tl.load(levels + level * 5 + 2).to(along_z.dtype)
    _store_inside(positions, out, samples, valid, 0, grad_x)
    _store_inside(positions, out, samples, valid, 1, grad_y)
    _store_inside(positions, out, samples, valid, 2, grad_z)


@triton.jit
def _store_inside(positions, out, samples, valid, axis: tl.constexpr, gradient):
    """Store the gradient along one axis, zero where the position was clamped."""
    position = tl.load(positions + samples * 3 + axis, valid, 0.0)
    inside = (position >= 0) & (position <= 1)
    tl.store(out + samples * 3 + axis, tl.where(inside, gradient, 0.0), valid)
