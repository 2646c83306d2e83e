"""The work of `suite=kernels` that asks a field's network: at places, and along rays."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from dnerf.kernels import GridLevels, NetworkTables, grid_network, trace_network
from dnerf.rays import Rays

HEAD = (64, 64, 4)  # widths of the layers behind a grid's features


def network_call(positions: Tensor, table: Tensor, levels: GridLevels) -> Callable[[], Tensor]:
    """Asking a network on a grid's features at places (N, 3)."""
    weights, biases = _layers(levels.num_levels * table.shape[1])

    def call() -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return grid_network(positions, table, levels, weights, biases)

    return call


def network_tracing_call(
    rays: Rays, grid: tuple[Tensor, Tensor, Tensor], features: tuple[Tensor, GridLevels], side: int, step: float
) -> Callable[[], Any]:
    """Following rays through occupied cells: matter is thin, displacements are zero and steps stay whole.

    Args:
        rays: R rays of one time.
        grid: occupancy, skips and box of its cells, see `NetworkTables`.
        features: of the field, in the same box.
        side: vertices along each side of the displacements' lattice.
        step: length of an interval, in world units.
    """
    (occupancy, skips, box), (table, levels) = grid, features
    weights, biases = _layers(levels.num_levels * table.shape[1])
    low, sides = box[0], box[1] - box[0]
    tables = NetworkTables(
        occupancy=occupancy, skips=skips, aabb=box, low=low, sides=sides, levels=levels, table=table, weights=weights,
        displacements=torch.zeros(side**3, 4), is_known=torch.ones(side, side, side, dtype=torch.bool), biases=biases,
        field_low=low, field_scale=1 / sides, shifts=torch.tensor([-10.0, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    is_left = torch.zeros(len(rays), dtype=torch.bool)

    def call() -> tuple[Tensor, Tensor]:
        with torch.autocast("cpu", torch.bfloat16):
            return trace_network(
                rays.origins, rays.directions, rays.near, rays.far, is_left, tables, step=step, splits=1,
                min_weight=0.0, split_weight=0.0, stop_transmittance=1e-4,
            )  # fmt: skip

    return call


def _layers(in_features: int) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases of a field's network."""
    widths, generator = (in_features, *HEAD), torch.Generator().manual_seed(0)
    weights = [torch.randn(b, a, generator=generator) / a**0.5 for a, b in pairwise(widths)]
    return weights, [torch.zeros(b) for b in widths[1:]]
