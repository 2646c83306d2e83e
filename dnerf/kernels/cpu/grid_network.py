# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `grid_network`: a few hundred places go through encoding and layers before the next ones begin."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from ..relu_layers import is_bfloat16_wanted
from .cells import PLACES, cell_tables, fractions_at, locate_all, rows_at, take_places
from .dense import LANES, MOST_ROWS, Packed, at_once, dense, has_vectors, is_supported
from .grid_encode import levels_of
from .launch import BORROWS, FAST, array, kernel, launch, next_task, none_taken, num_threads
from .rows import blend_rows

ROOM = PLACES + MOST_ROWS  # rows of a worker's tables: groups are full
ZERO, LEAST = np.float32(0), np.float32(-np.inf)


def serves(positions: Tensor, in_features: int, weights: Sequence[Tensor], beside_tiles: bool) -> bool:
    """Whether networks of such sizes are served on this processor."""
    is_quickest = beside_tiles or is_supported() or not is_bfloat16_wanted(positions)
    is_deep = len(weights) > 1
    return is_quickest and in_features % 2 == 0 and is_deep and all(len(w) % LANES == 0 for w in weights[:-1])


def rounded(positions: Tensor, parameters: Sequence[Tensor]) -> list[Tensor]:
    """In the precision in which places are served now."""
    dtype = torch.bfloat16 if is_bfloat16_wanted(positions) and has_vectors() else torch.float32
    return [x.to(dtype) for x in parameters]


Widths = tuple[tuple[int, ...], ...]


def network_of(
    table: Tensor, cells: list[int], max_rows: int, weights: list[Tensor], biases: list[Tensor]
) -> tuple[tuple[np.ndarray, ...], Widths]:
    """What `ask_network` reads, and the lengths of vectors and groups, as tuples: constants to the compiler."""
    (group, vectors), last = at_once([len(w) for w in weights[:-1]]), at_once([last_width(weights)])
    levels, lanes = levels_of(tuple(cells), max_rows), (0,) * table.shape[1]
    counts = [len(vectors)] * (len(weights) - 1) + [len(last[1])]
    packed = Packed(len(levels) * len(lanes), weights, biases, counts)
    return (array(table), levels, packed.layers, packed.weights, packed.biases), (lanes, group, vectors, *last)


def last_width(weights: list[Tensor]) -> int:
    """Of a row of outputs in `found`: their number, in multiples of `LANES`."""
    return -(-len(weights[-1]) // LANES) * LANES


def room_of(weights: list[Tensor], workers: int) -> tuple[np.ndarray, ...]:
    """Of workers, each its own: what `ask_network` writes between its layers, and its outputs."""
    widest, dtype = max(len(weight) for weight in weights[:-1]), array(weights[0]).dtype
    return (
        np.zeros((workers, ROOM * weights[0].shape[1]), dtype),
        np.zeros((workers, 2, ROOM * widest), dtype),
        np.zeros((workers, ROOM * last_width(weights)), np.float32),
    )


def forward(
    positions: Tensor, table: Tensor, cells: list[int], max_rows: int, weights: list[Tensor], biases: list[Tensor]
) -> Tensor:
    network, widths = network_of(table, cells, max_rows, weights, biases)
    out, workers = positions.new_empty(len(positions), len(weights[-1])), num_threads()
    room, tables = room_of(weights, workers), cell_tables(np.float32, workers)
    launch(_network, array(positions), out.numpy(), network, room, tables, none_taken(), *widths)
    return out


@kernel(fastmath=FAST, **BORROWS)
def _network(
    positions: Any, out: Any, network: Any, room: Any, tables: Any, taken: Any, lanes: Any, group: Any, vectors: Any,
    last_group: Any, last_vectors: Any,
) -> None:  # fmt: skip
    for worker in prange(len(room[0])):
        widths = lanes, group, vectors, last_group, last_vectors
        places, fractions, rows = tables[0][worker], tables[1][worker], tables[2][worker]
        encoded, hidden, found = room[0][worker], room[1][worker], room[2][worker]
        first = next_task(taken) * PLACES
        width = len(found) // ROOM
        while first < len(positions):
            count = take_places(positions, first, places)
            ask_network(count, network, widths, (places, fractions, rows), encoded, hidden, found)
            for i in range(count):
                for k in range(out.shape[1]):
                    out[first + i, k] = found[i * width + k]
            first = next_task(taken) * PLACES


@njit(fastmath=FAST, **BORROWS)
def ask_network(count: int, network: Any, widths: Any, tables: Any, encoded: Any, hidden: Any, found: Any) -> None:
    """The outputs, in rows of `last_width`, for so many places, which are in the first table."""
    table, levels, layers, weights, biases = network
    lanes, group, vectors, last_group, last_vectors = widths
    places, fractions, rows = tables
    num_hidden, num_features = len(layers) - 1, layers[0, 0]
    for j in range(len(levels)):
        level = levels[j]
        locate_all(places, count, level, rows, fractions)
        start = j * len(lanes)
        for i in range(count):
            blend_rows(table, level[3], rows_at(rows, i), fractions_at(fractions, i), encoded, start, lanes)
            start += num_features
    dense(encoded, 0, layers[0], weights, biases, hidden[0], 0, count, group, vectors, ZERO)
    for i in range(1, num_hidden):
        dense(hidden[(i - 1) % 2], 0, layers[i], weights, biases, hidden[i % 2], 0, count, group, vectors, ZERO)
    last = hidden[(num_hidden - 1) % 2]
    dense(last, 0, layers[num_hidden], weights, biases, found, 0, count, last_group, last_vectors, LEAST)
