"""Where samples of rays are by a lattice of displacements."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under
from torch import Tensor

from dnerf.kernels import lattice_places
from dnerf.kernels.lattice_places import lattice_places_reference

SHAPE = (4, 3, 5)  # z, y, x
LOW, SIDES = torch.tensor([-1.0, -0.5, 0.0]), torch.tensor([2.0, 1.5, 1.0])


def vertices() -> Tensor:
    """(60, 3), x fastest."""
    z, y, x = torch.meshgrid(*(torch.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    return LOW + SIDES * torch.stack([x, y, z], dim=-1).reshape(-1, 3)


def rays(num_rays: int, count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
    """Origins, directions, numbers of rays and distances of places, of which some lie outside the lattice."""
    g = torch.Generator().manual_seed(seed)
    inside = LOW + SIDES * torch.rand(num_rays, 3, generator=g)
    directions = torch.nn.functional.normalize(torch.randn(num_rays, 3, generator=g), dim=-1)
    indices = torch.randint(num_rays, (count,), generator=g).sort().values
    distances = 2 + 0.8 * torch.randn(count, generator=g)
    return (inside - 2 * directions).to(dtype), directions.to(dtype), indices, distances.to(dtype)


@settings(max_examples=40, deadline=None)
@given(
    num_rays=st.integers(1, 9),
    count=st.integers(0, 700),
    columns=st.sampled_from([3, 4, 8]),
    num_unknown=st.integers(0, 5),
    seed=st.integers(0, 9),
)
def test_numba_equals_the_definition(num_rays: int, count: int, columns: int, num_unknown: int, seed: int) -> None:
    table = 0.1 * torch.randn(60, columns, generator=torch.Generator().manual_seed(seed))
    table[:num_unknown] = torch.nan
    arguments = (*rays(num_rays, count, seed), table, SHAPE, LOW, SIDES)
    found, expected = under("numba", lattice_places, *arguments), lattice_places_reference(*arguments)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6, equal_nan=True)


@pytest.mark.usefixtures("backend")
def test_displacements_that_are_linear_in_space_are_exact() -> None:
    matrix = torch.tensor([[0.1, 0.3, 0.0], [0.0, -0.2, 0.1], [0.4, 0.0, 0.2]])
    table = torch.nn.functional.pad(vertices() @ matrix.T, (0, 1))
    origins, directions, indices, distances = rays(20, 500)
    places = lattice_places(origins, directions, indices, distances, table, SHAPE, LOW, SIDES)
    points = origins[indices] + distances[:, None] * directions[indices]
    unit = (points - LOW) / SIDES
    is_in = ((unit >= 0) & (unit <= 1)).all(-1)
    assert 100 < int(is_in.sum()) < 400
    torch.testing.assert_close(places[is_in], (points + points @ matrix.T)[is_in], rtol=0, atol=1e-6)
    assert bool(places[~is_in].isnan().all())


def test_cells_with_an_unknown_vertex_are_unknown_and_no_others() -> None:
    table = torch.zeros(60, 4)
    table[0] = torch.nan  # the lowest corner
    direction = torch.tensor([[1.0, 0.0, 0.0]])
    origins = LOW + torch.tensor([[-1.0, 0.05, 0.05], [-1.0, 0.9, 0.05]])  # in the first cell along y, in the second
    distances, indices = torch.tensor([1.1, 1.4, 1.6, 1.1]), torch.tensor([0, 0, 0, 1])  # cells along x: half a unit
    places = lattice_places(origins, direction.expand(2, 3), indices, distances, table, SHAPE, LOW, SIDES)
    assert places[:, 0].isnan().tolist() == [True, True, False, False]


def test_places_that_are_no_numbers_stay_so() -> None:
    origins, directions, indices, distances = rays(2, 4)
    distances[1] = torch.nan
    places = lattice_places(origins, directions, indices, distances, torch.zeros(60, 4), SHAPE, LOW, SIDES)
    assert bool(places[1].isnan().all())


def test_wrong_arguments_are_named() -> None:
    origins, directions, indices, distances = rays(2, 4)
    table = torch.zeros(60, 4)
    for shape, rows, rays_of, message in (
        (SHAPE, table[1:], indices, r"displacements must have shape .* of \(4, 3, 5\) vertices"),
        ((4, 1, 5), table[:20], indices, "at least two each"),
        (SHAPE, table, indices[1:], "ray_indices must have shape"),
        (SHAPE, table, indices + 5, r"ray_indices must lie in \[0, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            lattice_places(origins, directions, rays_of, distances, rows, shape, LOW, SIDES)
