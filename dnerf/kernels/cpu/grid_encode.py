# mypy: disable-error-code="call-arg,var-annotated"
"""numba versions of `grid_encode` and its gradients."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from ..grid_encode import GridLevels
from .cells import PLACES, cell_tables, fractions_at, locate_all, rows_at, take_places, trilinear_weights
from .launch import BORROWS, FAST, array, kernel, launch, next_task, none_taken, num_threads
from .rows import add_to_row, blend_rows, dot_slopes

# A table gradient's rows are dealt out in blocks of 2^6: fine enough to balance crowded regions of a dense level.
ROW_BLOCK_BITS = 6


def forward(positions: Tensor, table: Tensor, cells: list[int], max_rows: int, rounded: bool) -> Tensor:
    levels, lanes = levels_of(tuple(cells), max_rows), (0,) * table.shape[1]
    size, dtype = (len(positions), len(levels) * len(lanes)), torch.bfloat16 if rounded else table.dtype
    out = table.new_empty(size, dtype=dtype)
    launch(_forward, array(positions), array(table), levels, array(out), *_workers(positions), lanes)
    return out


def grad_table(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    levels, lanes = levels_of(tuple(cells), max_rows), (0,) * table.shape[1]
    out = torch.zeros_like(table, memory_format=torch.contiguous_format)
    part_bits = max(0, (num_threads() - 1) // len(levels)).bit_length()
    arrays = array(grad), array(positions)
    launch(_grad_table, *arrays, levels, part_bits, out.numpy(), *_workers(positions), lanes)
    return out


def grad_positions(grad: Tensor, positions: Tensor, table: Tensor, cells: list[int], max_rows: int) -> Tensor:
    levels, lanes = levels_of(tuple(cells), max_rows), (0,) * table.shape[1]
    out = torch.empty_like(positions, memory_format=torch.contiguous_format)
    arrays = array(grad), array(positions), array(table)
    launch(_grad_positions, *arrays, levels, out.numpy(), *_workers(positions), lanes)
    return out


def _workers(positions: Tensor) -> tuple[Any, int, np.ndarray]:
    """Tables for as many workers as there are threads, their number, and the counter of the tasks they take."""
    threads = num_threads()
    return cell_tables(positions.detach().numpy().dtype, threads), threads, none_taken()


@lru_cache(maxsize=64)
def levels_of(cells: tuple[int, ...], max_rows: int) -> np.ndarray:
    """`GridLevels.describe` of cells per axis of every level, flattened."""
    triples = [cells[i : i + 3] for i in range(0, len(cells), 3)]
    return np.array(GridLevels(triples, max_rows).describe(), dtype=np.int64)


@kernel(fastmath=FAST, **BORROWS)
def _forward(
    positions: Any, table: Any, levels: Any, out: Any, tables: Any, num_workers: int, taken: Any, lanes: Any
) -> None:
    for worker in prange(num_workers):
        places, fractions, rows = tables[0][worker], tables[1][worker], tables[2][worker]
        first = next_task(taken) * PLACES
        while first < positions.shape[0]:
            count = take_places(positions, first, places)
            for j in range(levels.shape[0]):
                level = levels[j]
                locate_all(places, count, level, rows, fractions)
                start = first * out.shape[1] + j * len(lanes)
                for i in range(count):
                    blend_rows(table, level[3], rows_at(rows, i), fractions_at(fractions, i), out, start, lanes)
                    start += out.shape[1]
            first = next_task(taken) * PLACES


@kernel(fastmath=FAST, **BORROWS)
def _grad_table(
    grad: Any, positions: Any, levels: Any, part_bits: int, out: Any, tables: Any, num_workers: int, taken: Any,
    lanes: Any,
) -> None:  # fmt: skip
    """Scatter-add without atomics: a task owns one level, or every 2^part_bits-th block of its rows.

    Each row is added to by one thread, in the order of the samples: the result depends on no thread count. Fine levels
    come first: their rows lie far apart, so they take longest.
    """
    num_tasks = levels.shape[0] << part_bits
    part_mask = (1 << part_bits) - 1
    for worker in prange(num_workers):
        places, fractions, rows = tables[0][worker], tables[1][worker], tables[2][worker]
        task = num_tasks - 1 - next_task(taken)
        while task >= 0:
            level = levels[task >> part_bits]
            part = task & part_mask
            for first in range(0, positions.shape[0], PLACES):
                count = take_places(positions, first, places)
                locate_all(places, count, level, rows, fractions)
                start = first * grad.shape[1] + (task >> part_bits) * len(lanes)
                for i in range(count):
                    u, v, w = fractions_at(fractions, i)
                    weights, corners = trilinear_weights(u, v, w), rows_at(rows, i)
                    for k in range(8 if level[2] else 4):  # of a plane, the others weigh nothing
                        row = level[3] + corners[k]
                        if part_bits == 0 or (row >> ROW_BLOCK_BITS) & part_mask == part:
                            add_to_row(out, row, weights[k], grad, start, lanes)
                    start += grad.shape[1]
            task = num_tasks - 1 - next_task(taken)


@kernel(fastmath=FAST, **BORROWS)
def _grad_positions(
    grad: Any, positions: Any, table: Any, levels: Any, out: Any, tables: Any, num_workers: int, taken: Any, lanes: Any
) -> None:
    real = positions.dtype.type
    for worker in prange(num_workers):
        places, fractions, rows = tables[0][worker], tables[1][worker], tables[2][worker]
        first = next_task(taken) * PLACES
        while first < positions.shape[0]:
            count = take_places(positions, first, places)
            for i in range(first, first + count):
                out[i, 0], out[i, 1], out[i, 2] = real(0), real(0), real(0)
            for j in range(levels.shape[0]):
                level = levels[j]
                locate_all(places, count, level, rows, fractions)
                start = first * grad.shape[1] + j * len(lanes)
                for i in range(count):
                    shares = fractions_at(fractions, i)
                    along = dot_slopes(table, level[3], rows_at(rows, i), shares, grad, start, lanes)
                    for axis in range(3):
                        out[first + i, axis] += along[axis] * real(level[axis])
                    start += grad.shape[1]
            for i in range(first, first + count):
                for axis in range(3):
                    if not (real(0) <= positions[i, axis] <= real(1)):
                        out[i, axis] = real(0)
            first = next_task(taken) * PLACES
