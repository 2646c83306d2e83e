"""How a deformation stretches and folds space."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.deformations.base import Deformation, check_positions_times
from dnerf.deformations.inversion import jacobians

MIDDLE = (0.05, 0.95)
CHUNK = 1 << 15  # places whose derivatives are in memory at a time


@dataclass(frozen=True)
class Folding:
    """What the Jacobian matrices of a deformation say at several places."""

    least_determinant: float  # negative where space folds
    share_folded: float  # of the places, where it is negative
    stretch: tuple[float, float]  # the middle 90 % of the smallest singular value; 1 is rigid, 0 loses a dimension


def folding(deformation: Deformation, positions: Tensor, times: Tensor) -> Folding:
    """Look at the derivatives of canonical positions to world positions.

    Args:
        deformation: world -> canonical.
        positions: (..., 3) at least one, in world units.
        times: (...,) in [0, 1].

    Raises:
        ValueError: for shapes that do not fit, or no position.
    """
    check_positions_times(positions, times)
    if not positions.numel():
        raise ValueError("positions must be at least one, got none")
    parts = zip(positions.reshape(-1, 3).split(CHUNK), times.reshape(-1).split(CHUNK), strict=True)
    found = torch.cat([jacobians(deformation, *part) for part in parts])
    determinants, smallest = torch.linalg.det(found), torch.linalg.svdvals(found)[:, -1].sort().values
    low, high = (float(smallest[round(share * (len(smallest) - 1))]) for share in MIDDLE)
    return Folding(float(determinants.min()), float((determinants < 0).float().mean()), (low, high))
