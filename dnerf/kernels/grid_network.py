"""A small network on features of a grid, without gradients: for images and filters."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.checks import check_shape

from .backend import choose, run_compiled
from .grid_encode import GridLevels, check_grid, grid_encode
from .op import op
from .relu_layers import is_bfloat16_wanted, is_plain, relu_layers


@torch.no_grad()
def grid_network(
    positions: Tensor, table: Tensor, levels: GridLevels, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Tensor:
    """`relu_layers` of `grid_encode`, and a last linear layer: W x + b. Not differentiable.

    On CPUs, features and what is between layers never leave the nearest caches: in float32, and under autocast to
    bfloat16 on those that multiply vectors in it but no tiles (AMX), for hidden layers in multiples of 16 and an even
    number of features. The last layer's products are then not rounded.

    Args:
        positions: (N, 3), in [0, 1].
        table: (T, F), T = `levels.num_rows`.
        levels: the grid's resolutions and table layout.
        weights, biases: of each layer, at least two, (out_features, in_features) and (out_features,); the first one's
            inputs are the L F features.

    Returns:
        (N, out_features of the last layer).

    Raises:
        ValueError: a shape that does not fit, or fewer than two layers.
    """
    if len(weights) < 2 or len(weights) != len(biases):
        raise ValueError(f"weights and biases must be of at least two layers, got {len(weights)} and {len(biases)}")
    in_features = levels.num_levels * table.shape[-1]
    check_shape("the first weights", weights[0], ("n", in_features))
    if all(x.dtype == torch.float32 for x in (positions, table)) and is_fused(positions, in_features, weights):
        check_grid(positions, table, levels)
        rounded = [run_compiled("grid_network", "rounded", positions, x) for x in (weights, biases)]
        return _grid_network(positions, table, levels.cells, levels.max_rows, *rounded)
    return grid_network_reference(positions, table, levels, weights, biases)


def grid_network_reference(
    positions: Tensor, table: Tensor, levels: GridLevels, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Tensor:
    """The definition of `grid_network`: one after the other."""
    features = grid_encode(positions, table, levels, rounded=is_bfloat16_wanted(positions))
    hidden = relu_layers(features, weights[:-1], biases[:-1])
    return torch.nn.functional.linear(hidden, weights[-1], biases[-1])


def is_fused(positions: Tensor, in_features: int, weights: Sequence[Tensor], *, beside_tiles: bool = False) -> bool:
    """Whether a kernel is compiled for such networks, in the precision and on the processor of now.

    `beside_tiles`: also on processors that multiply whole tiles (AMX), where matrix libraries are as quick at layers.
    """
    if not (is_plain(positions) or is_bfloat16_wanted(positions)) or positions.is_cuda or choose(positions) != "numba":
        return False
    return run_compiled("grid_network", "serves", positions, in_features, weights, beside_tiles)


_grid_network = op(
    "grid_network(Tensor positions, Tensor table, int[] cells, int max_rows, Tensor[] weights, Tensor[] biases)"
    " -> Tensor",
    "grid_network.forward",
)
