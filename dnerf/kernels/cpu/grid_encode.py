# mypy: disable-error-code="call-arg,var-annotated"
"""numba versions of `grid_encode` and its gradients."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..grid_encode import GridLevels
from .launch import BORROWS, FAST, kernel, launch, num_threads
from .rows import add_to_row, blend_rows, dot_slopes
from .tasks import next_task, none_taken

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
# A table gradient's rows are dealt out in blocks of 2^6: fine enough to balance crowded regions of a dense level.
ROW_BLOCK_BITS = 6
SAMPLES_AT_ONCE = 256  # dealt out to threads


def forward(positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    out = table.new_empty((positions.shape[0], len(cells) // 3 * table.shape[1]))
    _launch_forward(positions, table, cells, max_rows, out.numpy())
    return out


def forward_rounded(positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    out = table.new_empty((positions.shape[0], len(cells) // 3 * table.shape[1]), dtype=torch.bfloat16)
    bits = out.view(torch.int16).numpy().view(np.uint16)
    _launch_forward(positions, table, cells, max_rows, bits)
    return out


def _launch_forward(positions: Tensor, table: Tensor, cells: list[int], max_rows: int, out: np.ndarray) -> None:
    launch(
        _forward,
        _array(positions),
        _array(table),
        _levels(tuple(cells), max_rows),
        out,
        num_threads(),
        none_taken(),
        (0,) * table.shape[1],
    )


def grad_table(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    levels = _levels(tuple(cells), max_rows)
    out = torch.zeros_like(table, memory_format=torch.contiguous_format)
    lanes = (0,) * table.shape[1]
    part_bits = max(0, (num_threads() - 1) // len(levels)).bit_length()
    launch(
        _grad_table, _array(grad), _array(positions), levels, part_bits, out.numpy(), num_threads(), none_taken(), lanes
    )
    return out


def grad_positions(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    out = torch.empty_like(positions, memory_format=torch.contiguous_format)
    launch(
        _grad_positions,
        _array(grad),
        _array(positions),
        _array(table),
        _levels(tuple(cells), max_rows),
        out.numpy(),
        num_threads(),
        none_taken(),
        (0,) * table.shape[1],
    )
    return out


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


@lru_cache(maxsize=64)
def _levels(cells: tuple[int, ...], max_rows: int) -> np.ndarray:
    triples = [cells[i : i + 3] for i in range(0, len(cells), 3)]
    return np.array(GridLevels(triples, max_rows).describe(), dtype=np.int64)


@njit(fastmath=FAST, **BORROWS)
def locate(position: Any, num_cells: int) -> Any:
    """Lower vertex and fraction along one axis. A NaN gives vertex 0 and fraction NaN, never a wild index."""
    one = type(position)(1)
    zero = type(position)(0)
    clamped = zero if position < zero else (one if position > one else position)
    scaled = clamped * type(position)(num_cells)
    lower = min(np.int64(scaled), num_cells - 1) if scaled >= zero else 0
    return lower, scaled - type(position)(lower)


@njit(fastmath=FAST, **BORROWS)
def _rows(x: int, y: int, z: int, level: Any) -> Any:
    """Table rows of the 8 vertices of a cell; bit 0 of the vertex number is x, bit 1 y, bit 2 z."""
    offset, mask = level[3], level[4]
    if mask < 0:
        row_y = level[0] + 1
        row_z = row_y * (level[1] + 1)
        a = offset + x + y * row_y + z * row_z
        b, c, d = a + row_y, a + row_z, a + row_y + row_z
        return a, a + 1, b, b + 1, c, c + 1, d, d + 1
    y0, z0 = y * PRIME_Y, z * PRIME_Z
    y1, z1 = y0 + PRIME_Y, z0 + PRIME_Z
    return (
        offset + ((x ^ y0 ^ z0) & mask),
        offset + ((x + 1 ^ y0 ^ z0) & mask),
        offset + ((x ^ y1 ^ z0) & mask),
        offset + ((x + 1 ^ y1 ^ z0) & mask),
        offset + ((x ^ y0 ^ z1) & mask),
        offset + ((x + 1 ^ y0 ^ z1) & mask),
        offset + ((x ^ y1 ^ z1) & mask),
        offset + ((x + 1 ^ y1 ^ z1) & mask),
    )


@njit(fastmath=FAST, **BORROWS)
def trilinear_weights(u: Any, v: Any, w: Any) -> Any:
    """Trilinear weights of the 8 vertices, in the order of `_rows`."""
    one = type(u)(1)
    a, b, c, d = (one - v) * (one - w), v * (one - w), (one - v) * w, v * w
    return (one - u) * a, u * a, (one - u) * b, u * b, (one - u) * c, u * c, (one - u) * d, u * d


@kernel(fastmath=FAST, **BORROWS)
def _forward(positions: Any, table: Any, levels: Any, out: Any, num_workers: int, taken: Any, lanes: Any) -> None:
    for _ in prange(num_workers):
        first = next_task(taken) * SAMPLES_AT_ONCE
        while first < positions.shape[0]:
            for i in range(first, min(first + SAMPLES_AT_ONCE, positions.shape[0])):
                for j in range(levels.shape[0]):
                    level = levels[j]
                    x, u = locate(positions[i, 0], level[0])
                    y, v = locate(positions[i, 1], level[1])
                    z, w = locate(positions[i, 2], level[2])
                    start = i * out.shape[1] + j * len(lanes)
                    blend_rows(table, _rows(x, y, z, level), trilinear_weights(u, v, w), out, start, lanes)
            first = next_task(taken) * SAMPLES_AT_ONCE


@kernel(fastmath=FAST, **BORROWS)
def _grad_table(
    grad: Any, positions: Any, levels: Any, part_bits: int, out: Any, num_workers: int, taken: Any, lanes: Any
) -> None:
    """Scatter-add without atomics: a task owns one level, or every 2^part_bits-th block of its rows.

    Each row is added to by one thread, in the order of the samples: the result depends on no thread count. Fine levels
    come first: their rows lie far apart, so they take longest.
    """
    num_tasks = levels.shape[0] << part_bits
    part_mask = (1 << part_bits) - 1
    for _ in prange(num_workers):
        task = num_tasks - 1 - next_task(taken)
        while task >= 0:
            level = levels[task >> part_bits]
            part = task & part_mask
            for i in range(positions.shape[0]):
                x, u = locate(positions[i, 0], level[0])
                y, v = locate(positions[i, 1], level[1])
                z, w = locate(positions[i, 2], level[2])
                rows = _rows(x, y, z, level)
                weights = trilinear_weights(u, v, w)
                start = i * grad.shape[1] + (task >> part_bits) * len(lanes)
                for k in range(8):
                    if part_bits == 0 or (rows[k] >> ROW_BLOCK_BITS) & part_mask == part:
                        add_to_row(out, rows[k], weights[k], grad, start, lanes)
            task = num_tasks - 1 - next_task(taken)


@kernel(fastmath=FAST, **BORROWS)
def _grad_positions(
    grad: Any, positions: Any, table: Any, levels: Any, out: Any, num_workers: int, taken: Any, lanes: Any
) -> None:
    one, zero = positions.dtype.type(1), positions.dtype.type(0)
    for _ in prange(num_workers):
        first = next_task(taken) * SAMPLES_AT_ONCE
        while first < positions.shape[0]:
            for i in range(first, min(first + SAMPLES_AT_ONCE, positions.shape[0])):
                grad_x, grad_y, grad_z = zero, zero, zero
                for j in range(levels.shape[0]):
                    level = levels[j]
                    x, u = locate(positions[i, 0], level[0])
                    y, v = locate(positions[i, 1], level[1])
                    z, w = locate(positions[i, 2], level[2])
                    rows = _rows(x, y, z, level)
                    start = i * grad.shape[1] + j * len(lanes)
                    along_x, along_y, along_z = dot_slopes(table, rows, (u, v, w), grad, start, lanes)
                    grad_x += along_x * positions.dtype.type(level[0])
                    grad_y += along_y * positions.dtype.type(level[1])
                    grad_z += along_z * positions.dtype.type(level[2])
                out[i, 0] = grad_x if zero <= positions[i, 0] <= one else zero
                out[i, 1] = grad_y if zero <= positions[i, 1] <= one else zero
                out[i, 2] = grad_z if zero <= positions[i, 2] <= one else zero
            first = next_task(taken) * SAMPLES_AT_ONCE
