"""The best forms of kernels in plain torch, which the compiled ones have to beat."""

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from dnerf.kernels import GridLevels
from dnerf.kernels.grid_encode import HASH_PRIMES


def corner_rows(positions: Tensor, levels: GridLevels) -> list[tuple[Tensor, Tensor]]:
    """Per level, the table rows (N, 8) of each position's cell and their trilinear weights (N, 8)."""
    corners = torch.tensor([(k & 1, k >> 1 & 1, k >> 2) for k in range(8)], device=positions.device)
    found = []
    for rx, ry, rz, offset, mask in levels.describe():
        cells = torch.tensor((rx, ry, rz), device=positions.device)
        scaled = positions.clamp(0, 1) * cells
        lower = scaled.detach().long().minimum(cells - 1)
        fraction = (scaled - lower)[:, None]
        weights = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        x, y, z = (lower[:, None] + corners).unbind(-1)
        hashed = (x * HASH_PRIMES[0] ^ y * HASH_PRIMES[1] ^ z * HASH_PRIMES[2]) & mask
        found.append((offset + (hashed if mask >= 0 else x + (rx + 1) * (y + (ry + 1) * z)), weights))
    return found


def plain_grid_encode(positions: Tensor, table: Tensor, levels: GridLevels) -> Tensor:
    """`grid_encode` as one `embedding_bag` over all levels: torch's own fused gather and weighted sum."""
    rows, weights = (torch.stack(x, 1) for x in zip(*corner_rows(positions, levels)))
    summed = embedding_bag(rows.reshape(-1, 8), table, mode="sum", per_sample_weights=weights.reshape(-1, 8))
    return summed.reshape(len(positions), -1)


def plain_packed_weights(optical_depth: Tensor, ray_indices: Tensor, offsets: Tensor) -> Tensor:
    """`packed_weights` from one cumulative sum over all rays, in float64 since float32 loses all precision."""
    total = torch.cat([optical_depth.new_zeros(1, dtype=torch.float64), optical_depth.double().cumsum(0)])
    before = (total[:-1] - total[offsets[ray_indices]]).to(optical_depth.dtype)
    return torch.exp(-before) * -torch.expm1(-optical_depth)
