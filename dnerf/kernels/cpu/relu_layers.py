# mypy: disable-error-code="call-arg,var-annotated"
"""numba version of `relu_layers`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from .dense import LANES, MOST_ROWS, Packed, at_once, dense, is_supported
from .launch import BORROWS, array, kernel, launch, next_task, none_taken, num_threads

ROWS, ZERO = 252, np.float32(0)  # rows dealt out to threads


def serves(inputs: Tensor, weights: Sequence[Tensor]) -> bool:
    """Whether layers of such sizes are served on this processor."""
    if inputs.dtype == torch.float32:
        fits = all(len(weight) % LANES == 0 and weight.dtype == torch.float32 for weight in weights)
        return fits and len(weights) > 1 and not torch.is_grad_enabled()  # with gradients MKL is as quick
    return is_supported() and inputs.shape[-1] % 2 == 0 and all(len(weight) % LANES == 0 for weight in weights)


def relu_layers(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], is_kept: bool) -> list[Tensor]:
    """Outputs (N, n) of the last layer for inputs (N, m), all in one precision; of all layers, if they are kept."""
    count, widths = len(inputs), [len(weight) for weight in weights]
    if count < MOST_ROWS:  # groups of rows are full, the last one begins earlier
        inputs = torch.nn.functional.pad(inputs, (0, 0, 0, MOST_ROWS - count))
    (group, vectors), workers = at_once(widths), num_threads()
    outputs, numbers = [inputs.new_empty(len(inputs), n) for n in widths[0 if is_kept else -1 :]], array(inputs).ravel()
    between = [] if is_kept else [np.empty(workers * (ROWS + MOST_ROWS) * n, numbers.dtype) for n in widths[:-1]]
    arrays = (numbers, *between, *(array(x).ravel() for x in outputs))
    packed = Packed(inputs.shape[1], weights, biases, [len(vectors)] * len(weights))
    launch(
        _layers, arrays, len(inputs), is_kept, packed.layers, packed.weights, packed.biases, workers, none_taken(),
        group, vectors,
    )  # fmt: skip
    return [x[:count] for x in outputs]


@kernel(**BORROWS)
def _layers(
    arrays: Any, count: int, is_kept: bool, layers: Any, weights: Any, biases: Any, workers: int, taken: Any,
    group: Any, vectors: Any,
) -> None:  # fmt: skip
    last = len(layers)
    for worker in prange(workers):
        first = next_task(taken) * ROWS
        while first < count:
            first = max(0, min(first, count - MOST_ROWS))
            size = min(ROWS, count - first)
            whole = size - size % len(group)
            own = worker * (ROWS + MOST_ROWS)
            for i in range(last):
                here = first if i == 0 or is_kept else own
                there = first if i + 1 == last or is_kept else own
                inputs, out = arrays[i], arrays[i + 1]
                dense(inputs, here, layers[i], weights, biases, out, there, whole, group, vectors, ZERO)
                if whole < size:
                    back = size - len(group)
                    dense(inputs, here + back, layers[i], weights, biases, out, there + back, 1, group, vectors, ZERO)
            first = next_task(taken) * ROWS
