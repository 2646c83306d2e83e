"""Masks of grid cells over time slabs and space."""

from collections.abc import Sequence

import torch
from torch import Tensor


def widened(mask: Tensor, axes: Sequence[int]) -> Tensor:
    """A mask and its neighbours on both sides along some axes."""
    for axis in axes:
        result, size = mask.clone(), mask.shape[axis] - 1
        result.narrow(axis, 1, size).logical_or_(mask.narrow(axis, 0, size))
        result.narrow(axis, 0, size).logical_or_(mask.narrow(axis, 1, size))
        mask = result
    return mask


def slab_halves(mask: Tensor) -> Tensor:
    """A mask (K, ...) for halves of its slabs (2 K, ...), each with the neighbour that is nearer in time."""
    before, after = torch.cat([mask[:1], mask[:-1]]), torch.cat([mask[1:], mask[-1:]])
    return torch.stack([mask | before, mask | after], dim=1).flatten(0, 1)


def spread_over(mask: Tensor, unit: Tensor) -> Tensor:
    """Numbers (N,) of the places of a mask that hold, for shares (N,) in [0, 1) of all of those; of any if none holds.

    It asks a device for nothing, unlike a list of those places.
    """
    numbers = mask.view(-1).cumsum(0)
    found = torch.searchsorted(numbers, (unit * numbers[-1]).long(), right=True)
    return torch.where(numbers[-1] > 0, found, (unit * len(numbers)).long()).clamp(max=len(numbers) - 1)
