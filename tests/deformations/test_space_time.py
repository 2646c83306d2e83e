"""The lattice over space and time against a sum over all its vertices."""

import pytest
import torch
from torch import Tensor

from dnerf.deformations.space_time import SpaceTimeLattice
from dnerf.kernels import use_backend

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 0.5))


def lattice() -> SpaceTimeLattice:
    return SpaceTimeLattice(BOX, 4, 4)


def points(count: int) -> tuple[Tensor, Tensor]:
    low, high = torch.tensor(BOX, dtype=torch.float64)
    return torch.lerp(low, high, torch.rand(count, 3, dtype=torch.float64)), torch.rand(count, dtype=torch.float64)


def hats(grid: SpaceTimeLattice, positions: Tensor, times: Tensor) -> Tensor:
    """Weight of every vertex (N, K V): a product of hat functions, by definition."""
    vertices, knots = grid.place(torch.arange(grid.num_knots * grid.num_vertices))
    low, high = torch.tensor(BOX, dtype=torch.float64)
    spacing = (high - low) / torch.tensor(grid.cells)
    in_space = (1 - ((positions[:, None] - vertices) / spacing).abs()).clamp(min=0).prod(-1)
    return in_space * (1 - (times[:, None] - knots).abs() * (grid.num_knots - 1)).clamp(min=0)


def test_cells_are_nearly_cubes() -> None:
    assert lattice().cells == [4, 4, 3]
    assert lattice().num_vertices == 5 * 5 * 4


@pytest.mark.parametrize("backend", ["reference", "auto"])
def test_interpolation_is_the_sum_of_hat_functions(backend: str) -> None:
    grid = lattice()
    positions, times = points(100)
    values = torch.randn(4, grid.num_vertices, 4, dtype=torch.float64)
    expected = hats(grid, positions, times) @ values.reshape(-1, 4)
    with use_backend(backend):
        found = grid.interpolate(grid.pairs(values), grid.locate(positions, times))
    # Vertices are placed in float32.
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


def test_outside_counts_as_the_nearest_face_and_the_first_or_last_time() -> None:
    grid = lattice()
    positions, times = points(50)
    pairs = grid.pairs(torch.randn(4, grid.num_vertices, 4, dtype=torch.float64))
    far, late = 3 * positions, 4 * times - 1.5
    low, high = torch.tensor(BOX, dtype=torch.float64)
    inside = torch.minimum(torch.maximum(far, low), high), late.clamp(0, 1)
    found = grid.interpolate(pairs, grid.locate(far, late))
    # Stacked layers are located to the rounding of a few hundred.
    torch.testing.assert_close(found, grid.interpolate(pairs, grid.locate(*inside)), rtol=0, atol=1e-9)


def test_touched_vertices_are_those_with_weight() -> None:
    grid = lattice()
    positions, times = points(12)
    needed = (hats(grid, positions, times) > 1e-6).any(0)
    assert torch.equal(grid.touched(grid.locate(positions, times)).reshape(-1), needed)


def test_gradcheck_to_positions_times_and_values() -> None:
    grid = lattice()
    positions, times = points(5)
    values = torch.randn(4, grid.num_vertices, 4, dtype=torch.float64)

    def read(positions: Tensor, times: Tensor, values: Tensor) -> Tensor:
        return grid.interpolate(grid.pairs(values), grid.locate(positions, times))

    inputs = [t.requires_grad_() for t in (positions, times, values)]
    assert torch.autograd.gradcheck(read, inputs)
