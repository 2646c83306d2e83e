"""Planes over space and time: what their products can say, exactly."""

import pytest
import torch
from torch import Tensor

from dnerf.fields import PlaneFeatures, PlanesField

BOX = [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]]
AXES = ((0, 1), (0, 2), (1, 2), (2, 3), (1, 3), (0, 3))


def filled(join: str = "product", num_times: int | None = 3) -> PlaneFeatures:
    """Planes of random features, of two levels: cells of a unit and of a half, three of them in time."""
    planes = PlaneFeatures(BOX, (4, 8), num_times, num_features=2, join=join).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for plane in planes.tables:
            plane.copy_(torch.randn(plane.shape, generator=generator, dtype=torch.float64))
    return planes


def some_places(count: int = 40, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    corners = torch.tensor(BOX, dtype=dtype)
    unit = torch.rand(count, 3, generator=generator, dtype=dtype)
    return torch.lerp(corners[0], corners[1], unit), torch.rand(count, generator=generator, dtype=dtype)


def hats(values: Tensor, count: int) -> Tensor:
    """Weights (N, count + 1) of the vertices of so many cells at places (N,) in [0, 1]."""
    return (1 - (values[:, None] * count - torch.arange(count + 1.0, dtype=values.dtype)).abs()).clamp(min=0)


def looked_up(planes: PlaneFeatures, positions: Tensor, times: Tensor) -> list[list[Tensor]]:
    """Each level's planes at places, as `hats' values hats`."""
    corners = torch.tensor(BOX, dtype=torch.float64)
    unit = torch.cat([(positions - corners[0]) / (corners[1] - corners[0]), times[:, None]], dim=1)
    levels, first = [], [0] * 6
    for cells in ((2, 1, 4, 3), (4, 2, 8, 3)):
        found = []
        for number, (i, j) in enumerate(AXES[: len(planes.tables)]):
            rows = (cells[i] + 1) * (cells[j] + 1)
            values = planes.tables[number][first[number] : first[number] + rows].view(cells[j] + 1, cells[i] + 1, 2)
            first[number] += rows
            weights = hats(unit[:, j], cells[j]), hats(unit[:, i], cells[i])
            found.append(torch.einsum("nv,nu,vuf->nf", *weights, values))
        levels.append(found)
    return levels


@pytest.mark.parametrize("num_times", [3, None])
def test_planes_are_multiplied_all_or_each_with_what_it_leaves_out(num_times: int | None) -> None:
    """In pairs, level by level: xy with zt, xz with yt, yz with xt."""
    positions, times = some_places()
    for join in ("product", "pairs"):
        planes = filled(join, num_times)
        found = looked_up(planes, positions, times)
        if join == "product":
            expected = [torch.stack(level).prod(0) for level in found]
        else:
            rest = torch.ones(3) if num_times is None else None
            expected = [a * b for x in found for a, b in zip(x[:3], x[3:] if rest is None else rest, strict=True)]
        torch.testing.assert_close(planes(positions, times), torch.cat(expected, dim=1), rtol=1e-12, atol=1e-12)
        assert planes.is_static == (num_times is None)


def on_vertices(planes: PlaneFeatures, number: int, f: Tensor, g: Tensor) -> None:
    """One plane of one feature as a product of functions of its two axes, given on vertices."""
    planes.tables[number].data[:, 0] = (g[:, None] * f).reshape(-1)


def test_a_product_of_functions_of_each_axis_is_exact() -> None:
    """f(x) g(y) h(z) k(t), linear between vertices, from what two planes of each way to join hold."""
    positions, times = some_places()
    corners = torch.tensor(BOX, dtype=torch.float64)
    unit = torch.cat([(positions - corners[0]) / (corners[1] - corners[0]), times[:, None]], dim=1)
    cells, generator = (4, 2, 8, 5), torch.Generator().manual_seed(2)
    values = [torch.randn(n + 1, generator=generator, dtype=torch.float64) for n in cells]
    expected = torch.ones(40, dtype=torch.float64)
    for axis, (count, function) in enumerate(zip(cells, values, strict=True)):
        expected = expected * (hats(unit[:, axis], count) @ function)
    for join, column in (("product", 0), ("pairs", 0), ("pairs", 1), ("pairs", 2)):
        planes = PlaneFeatures(BOX, (8,), 5, num_features=1, join=join).double()
        for plane in planes.tables:
            torch.nn.init.ones_(plane)
        for number in (column, column + 3):
            i, j = AXES[number]
            on_vertices(planes, number, values[i], values[j])
        torch.testing.assert_close(planes(positions, times)[:, column], expected, rtol=1e-12, atol=1e-12)


def test_a_sum_of_three_products_is_exact_in_pairs() -> None:
    """sin(x) + sin(y) + sin(z) of vertices: a sum of the three columns."""
    planes = PlaneFeatures([[0, 0, 0], [1, 1, 1]], (4,), 2, num_features=1, join="pairs").double()
    waves = torch.sin(3 * torch.linspace(0, 1, 5, dtype=torch.float64))
    ones = torch.ones(5, dtype=torch.float64)
    for number, functions in enumerate(((waves, ones), (ones, waves), (waves, ones))):  # x of xy, z of xz, y of yz
        on_vertices(planes, number, *functions)
    grid = torch.cartesian_prod(*[torch.linspace(0, 1, 5, dtype=torch.float64)] * 3)
    found = planes(grid, torch.full((125,), 0.3, dtype=torch.float64)).sum(1)
    torch.testing.assert_close(found, torch.sin(3 * grid).sum(1), rtol=1e-12, atol=1e-12)


def test_a_fresh_field_is_at_rest_and_may_move() -> None:
    field = PlanesField(PlaneFeatures(BOX, (4, 8), 3))
    positions, times = some_places(dtype=torch.float32)
    assert not field.is_static
    assert torch.equal(field.density(positions, times), field.density(positions, 1 - times))
    field.density(positions, times).sum().backward()
    assert all(plane.grad.abs().sum() > 0 for plane in field.planes.tables)  # type: ignore[union-attr]
    assert PlanesField(PlaneFeatures(BOX, (4,), None)).is_static
    assert not PlanesField(PlaneFeatures(BOX, (4,), None), temporal_terms=2).is_static


@pytest.mark.parametrize("join", ["product", "pairs"])
def test_gradients_are_those_of_finite_differences(join: str) -> None:
    planes = filled(join)
    positions, times = some_places(5)
    names = [name for name, _ in planes.named_parameters()]

    def of(places: Tensor, *tables: Tensor) -> Tensor:
        return torch.func.functional_call(planes, dict(zip(names, tables, strict=True)), (places, times))

    assert torch.autograd.gradcheck(of, (positions.requires_grad_(), *planes.parameters()), fast_mode=True)


def test_roughness_is_of_differences_in_space_and_of_second_differences_in_time() -> None:
    planes = PlaneFeatures([[0, 0, 0], [1, 1, 1]], (4,), 5, num_features=1)
    for (_, j), plane, levels in zip(AXES, planes.tables, planes.levels, strict=True):
        a, b, _ = (torch.arange(n + 1.0) for n in levels.resolutions[0])
        plane.data[:, 0] = ((1.5 * b**2 + 5 * b if j == 3 else -2 * b)[:, None] + 0.5 * a).reshape(-1)
    in_space, in_time = (float(x.detach()) for x in planes.roughness())
    assert in_space == pytest.approx(6 * 0.5**2 + 3 * 2**2)
    assert in_time == pytest.approx(3 * 3**2)
    assert float(filled(num_times=None).roughness()[1]) == 0


@pytest.mark.parametrize(("arguments", "message"), [
    ({"box": [[0, 0, 0], [1, 0, 1]]}, "box must have finite corners"), ({"resolutions": (0,)}, "resolutions must"),
    ({"resolutions": ()}, "resolutions"), ({"resolutions": (200000,)}, "need 8347 GiB"),
    ({"num_times": 0}, "num_times must be"),
    ({"num_features": 0}, "num_features must be > 0"), ({"join": "sum"}, "join must be one of product, pairs; got"),
])  # fmt: skip
def test_bad_planes_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PlaneFeatures(**{"box": BOX, **arguments})
