"""Where samples of rays are in canonical space, by a lattice of displacements."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from .backend import choose, run_compiled
from .checks import check_shapes
from .grid_encode import GridLevels, grid_encode_reference


@torch.no_grad()
def lattice_places(
    origins: Tensor, directions: Tensor, ray_indices: Tensor, distances: Tensor, displacements: Tensor,
    shape: Sequence[int], low: Tensor, sides: Tensor,
) -> Tensor:  # fmt: skip
    """Positions at distances along rays, plus displacements interpolated between a lattice's vertices.

    Not differentiable.

    Args:
        origins: (R, 3), world units.
        directions: (R, 3), unit norm.
        ray_indices: (N,) int64, the ray of each place.
        distances: (N,) along it, world units.
        displacements: (V, C), C >= 3, of the vertices, x fastest; the first three numbers are the displacement in world
            units, NaN where it is not known.
        shape: vertices along z, y and x, at least two each; V in all.
        low, sides: (3,) lowest corner and sides of the lattice, in world units.

    Returns:
        (N, 3); NaN outside the lattice, and in cells of which a vertex is not known.

    Raises:
        ValueError: shapes that do not fit each other, or (by the compiled version) rays that do not exist.
    """
    count, columns = len(distances), displacements.shape[-1]
    if len(shape) != 3 or min(shape) < 2 or columns < 3 or displacements.shape != (math.prod(shape), columns):
        raise ValueError(
            f"displacements must have shape (V, 3 or more) of {tuple(shape)} vertices, at least two each, got "
            f"{tuple(displacements.shape)}"
        )
    check_shapes(origins=(origins, ("R", 3)), directions=(directions, (len(origins), 3)), low=(low, (3,)))
    check_shapes(ray_indices=(ray_indices, (count,)), distances=(distances, (count,)), sides=(sides, (3,)))
    arguments = (origins, directions, ray_indices, distances, displacements, shape, low, sides)
    is_single = all(x.dtype == torch.float32 for x in (origins, directions, distances, displacements, low, sides))
    if is_single and columns == 4 and choose(distances) == "numba":
        return run_compiled("lattice_places", "lattice_places", *arguments)
    return lattice_places_reference(*arguments)


def lattice_places_reference(
    origins: Tensor, directions: Tensor, ray_indices: Tensor, distances: Tensor, displacements: Tensor,
    shape: Sequence[int], low: Tensor, sides: Tensor,
) -> Tensor:  # fmt: skip
    """The definition of `lattice_places` in plain torch."""
    positions = origins[ray_indices] + distances[:, None] * directions[ray_indices]
    unit = (positions - low) / sides
    levels = GridLevels([[length - 1 for length in reversed(shape)]], 1 << (len(displacements) - 1).bit_length())
    moved = positions + grid_encode_reference(unit, displacements[:, :3], levels)
    return torch.where(((unit >= 0) & (unit <= 1)).all(-1)[:, None], moved, torch.nan)
