"""Space-time volumes: products of three interpolated tables, and what they can say."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from dnerf.fields import GridField, SpaceTimeVolumes

BOX = [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]]
AXES = ((0, 1), (0, 2), (1, 2))


def filled(std: float = 0.5, dtype: torch.dtype = torch.float64) -> SpaceTimeVolumes:
    """Volumes of random features, of two levels: cells of a unit and of a half, two and four of them in time."""
    volumes = SpaceTimeVolumes(BOX, (4, 8), (2, 4), num_features=3).to(dtype)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for table in volumes.tables:
            table.copy_(std * torch.randn(table.shape, generator=generator, dtype=dtype))
    return volumes


def some_places(count: int = 50, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    corners = torch.tensor(BOX, dtype=dtype)
    unit = torch.rand(count, 3, generator=generator, dtype=dtype)
    return torch.lerp(corners[0], corners[1], unit), torch.rand(count, generator=generator, dtype=dtype)


CELLS = [[(2, 1, 2), (4, 2, 4)], [(2, 4, 2), (4, 8, 4)], [(1, 4, 2), (2, 8, 4)]]
"""Of the levels of each volume of `filled`, along two axes of a box of 2 x 1 x 4 and along time."""


def looked_up(volumes: SpaceTimeVolumes, place: list[float], time: float) -> Tensor:
    """One place's features, vertex by vertex."""
    unit = [(p - low) / (high - low) for p, low, high in zip(place, *BOX, strict=True)]
    features, first = [], [0, 0, 0]
    for level in range(2):
        product = torch.ones(3, dtype=torch.float64)
        for number, (i, j) in enumerate(AXES):
            cells, table = CELLS[number][level], volumes.tables[number].detach()
            scaled = [u * n for u, n in zip((unit[i], unit[j], time), cells, strict=True)]
            factor, row = torch.ones(3, dtype=torch.float64), first[number]
            for vertex in itertools.product(*(range(n + 1) for n in reversed(cells))):  # the first axis is fastest
                weight = math.prod(max(0.0, 1 - abs(s - v)) for s, v in zip(scaled, reversed(vertex), strict=True))
                factor = factor + weight * table[row]
                row += 1
            product, first[number] = product * factor, row
        features.append(product - 1)
    return torch.cat(features)


def test_features_are_products_of_interpolated_volumes() -> None:
    volumes = filled()
    positions, times = some_places(20)
    expected = torch.stack([looked_up(volumes, p, t) for p, t in zip(positions.tolist(), times.tolist(), strict=True)])
    assert volumes.out_features == 6
    torch.testing.assert_close(volumes(positions, times), expected, rtol=1e-12, atol=1e-12)


def test_empty_tables_say_nothing_and_a_fresh_one_says_little() -> None:
    positions, times = some_places(dtype=torch.float32)
    assert volumes_range(SpaceTimeVolumes(BOX), positions, times) < 0.035  # 1.01^3 - 1, at all
    assert volumes_range(filled(0.0, torch.float32), positions, times) == 0


def volumes_range(volumes: SpaceTimeVolumes, positions: Tensor, times: Tensor) -> float:
    return float(volumes(positions, times).detach().abs().max())


def test_a_body_is_where_its_three_tubes_meet() -> None:
    """Tubes of one body, which goes from one end of the box to the other: its features are nowhere else."""
    volumes = SpaceTimeVolumes([[0, 0, 0], [1, 1, 1]], (4,), (4,), num_features=1)
    with torch.no_grad():
        for table, levels in zip(volumes.tables, volumes.levels, strict=True):
            table.fill_(-1)  # factors of 0
            for k in range(5):  # at time k / 4 the body is at vertex (k, k, k)
                table[k + 5 * (k + 5 * k)] = 1  # and of 2 in it
            assert levels.num_rows == 125
    steps = torch.arange(5) / 4
    for k, time in enumerate(steps):
        places = torch.cartesian_prod(steps, steps, steps)
        found = volumes(places, time.expand(len(places)))[:, 0]
        expected = torch.full((125,), -1.0)
        expected[k * (25 + 5 + 1)] = 7  # 2 * 2 * 2 - 1
        torch.testing.assert_close(found, expected)


def test_places_outside_see_the_nearest_face() -> None:
    volumes = filled()
    low, high = torch.tensor(BOX, dtype=torch.float64)
    positions, times = some_places()
    positions = positions + 3 * (positions - (low + high) / 2)
    inside = torch.minimum(torch.maximum(positions, low), high)
    torch.testing.assert_close(volumes(positions, times), volumes(inside, times), rtol=1e-12, atol=1e-12)


def test_gradients_are_those_of_finite_differences() -> None:
    volumes = filled()
    positions, times = some_places(5)
    positions.requires_grad_()
    names = [name for name, _ in volumes.named_parameters()]

    def of(places: Tensor, *tables: Tensor) -> Tensor:
        return torch.func.functional_call(volumes, dict(zip(names, tables, strict=True)), (places, times))

    assert torch.autograd.gradcheck(of, (positions, *volumes.parameters()), fast_mode=True)


def test_the_head_sees_them() -> None:
    """A fresh field hardly changes with time; one whose tables hold something does."""
    field = GridField(BOX, (4,), 2, hidden_features=16, space_time=SpaceTimeVolumes(BOX, (4,), (4,)))
    positions, times = some_places(dtype=torch.float32)
    assert not field.is_static
    first, later = (field.density(positions, t).detach() for t in (torch.zeros(50), times))
    torch.testing.assert_close(first, later, rtol=0.1, atol=0)
    assert field.space_time is not None
    for table in field.space_time.tables:
        torch.nn.init.normal_(table)
    first, later = (field.density(positions, t).detach() for t in (torch.zeros(50), times))
    assert ((later / first).log().abs() > 0.1).float().mean() > 0.5
    for parameter in (*field.space_time.tables, field.table):
        (gradient,) = torch.autograd.grad(field.density(positions, times).sum(), parameter)
        assert gradient.abs().sum() > 0


@pytest.mark.parametrize(("arguments", "message"), [
    (([[0, 0, 0], [1, 0, 1]],), "box must have finite corners"),
    ((BOX, (4, 8), (2,)), r"time_resolutions must have as many levels as resolutions \[4, 8\], got \[2\]"),
    ((BOX, (), ()), "resolutions"), ((BOX, (4,), (0,)), "time_resolutions must be > 0"),
])  # fmt: skip
def test_bad_volumes_are_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SpaceTimeVolumes(*arguments)
    with pytest.raises(ValueError, match="num_features must be > 0"):
        SpaceTimeVolumes(BOX, num_features=0)


def test_roughness_is_of_differences_in_space_and_of_second_differences_in_time() -> None:
    volumes = SpaceTimeVolumes([[0, 0, 0], [1, 1, 1]], (4, 2), (3, 5), num_features=2).double()
    for table in volumes.tables:
        torch.nn.init.constant_(table, 0.7)
    assert [float(x.detach()) for x in volumes.roughness()] == [0, 0]
    slopes = (0.5, -2.0, 3.0)  # along the first axis of space, the second, and time squared
    with torch.no_grad():
        for table, levels in zip(volumes.tables, volumes.levels, strict=True):
            for (u, v, t), first in zip(levels.resolutions, levels.offsets[:2], strict=True):
                grids = torch.meshgrid(*(torch.arange(n + 1.0) for n in (t, v, u)), indexing="ij")
                values = slopes[0] * grids[2] + slopes[1] * grids[1] + slopes[2] * grids[0] ** 2 / 2 + 5 * grids[0]
                table[first : first + values.numel()] = values.reshape(-1, 1).double()
    in_space, in_time = volumes.roughness()
    assert float(in_space.detach()) == pytest.approx(3 * 2 * (slopes[0] ** 2 + slopes[1] ** 2))  # volumes, levels
    assert float(in_time.detach()) == pytest.approx(3 * 2 * slopes[2] ** 2)
