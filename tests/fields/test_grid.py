"""The grid field: its box, and parts that do not exist unless asked for."""

from itertools import pairwise

import pytest
import torch

from dnerf.core.spherical_harmonics import spherical_harmonics
from dnerf.fields import GridField, PlaneFeatures
from dnerf.fields.base import warn_of_generic_path
from dnerf.fields.grid import GridFieldAtTime
from dnerf.kernels import grid_network, shade

BOX = [[-1.0, 0.0, 2.0], [1.0, 1.0, 6.0]]


def small(**options: object) -> GridField:
    field = GridField(BOX, (4, 8), 2, hidden_features=16, **options)  # type: ignore[arg-type]
    torch.nn.init.normal_(field.table)
    return field


def test_positions_outside_the_box_see_its_nearest_face() -> None:
    field, times = small(), torch.zeros(100)
    corners = torch.tensor(BOX)
    positions = corners[0] + (corners[1] - corners[0]) * (3 * torch.rand(100, 3) - 1)
    inside = torch.minimum(torch.maximum(positions, corners[0]), corners[1])
    torch.testing.assert_close(field.density(positions, times), field.density(inside, times), rtol=1e-4, atol=0)


def test_the_grid_spans_the_box() -> None:
    """Along every axis the density varies between the faces and the middle, on both sides."""
    field, corners = small(), torch.tensor(BOX)
    for axis in range(3):
        unit = torch.full((9, 3), 0.4)
        unit[:, axis] = torch.linspace(0, 1, 9)
        density = field.density(corners[0] + unit * (corners[1] - corners[0]), torch.zeros(9))
        assert (density.diff().abs() > 1e-6).all()


def test_cells_are_cubes() -> None:
    field = small()
    # Sides 2, 1, 4 at 4 and 8 cells along the longest; a level has one vertex more than cells along each axis.
    assert field.table.shape[0] == 3 * 2 * 5 + 5 * 3 * 9


def test_parts_that_are_not_asked_for_do_not_exist() -> None:
    def keys(**options: object) -> set[str]:
        return {name.split(".")[0] for name, _ in small(**options).named_modules() if name}

    assert keys() == {"head"}
    assert keys(view_degree=1) == {"head"}
    assert small(view_degree=1).head.out_features == 1 + 3 * 4
    assert small(view_degree=2, temporal_terms=4).head.out_features == 4 + 3 * (4 + 8)


@pytest.mark.parametrize(("view_degree", "one_color"), [(None, False), (1, False), (None, True)])
def test_density_and_colour_follow_cosine_series_that_begin_constant(view_degree: int | None, one_color: bool) -> None:
    """Before their activations, values at six times determine three cosines, and those the values at all others."""
    field = small(temporal_terms=3, view_degree=view_degree, one_color=one_color).double()
    positions = (torch.rand(20, 1, 3) + torch.tensor([0.0, 0.0, 3.0])).double().expand(20, 41, 3)
    times = torch.linspace(0, 1, 41, dtype=torch.float64).expand(20, 41)
    fresh = field(positions, positions, times)
    torch.testing.assert_close(fresh.density, fresh.density[:, :1].expand_as(fresh.density), rtol=1e-12, atol=0)
    torch.testing.assert_close(fresh.rgb, fresh.rgb[:, :1].expand_as(fresh.rgb), rtol=1e-12, atol=0)
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    output = field(positions, positions, times)
    values = torch.cat([output.density.log()[..., None], torch.logit(output.rgb)], dim=-1)
    basis = torch.cos(torch.pi * torch.arange(3, dtype=torch.float64) * times[0, :, None])
    found = torch.linalg.lstsq(basis[::8].expand(20, -1, -1), values[:, ::8]).solution
    torch.testing.assert_close(basis @ found, values, rtol=0, atol=1e-9)
    assert (found[:, 1:].abs().amax((0, 1)) > 1e-3).all()


def directions(count: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64)).to(dtype)


def test_degree_zero_is_matte() -> None:
    torch.manual_seed(0)
    glossy = small(temporal_terms=3, view_degree=0)
    torch.manual_seed(0)
    matte = small(temporal_terms=3)
    glossy.load_state_dict(matte.state_dict())
    places, times = torch.rand(50, 3), torch.rand(50)
    for a, b in ((glossy, matte), (glossy.at_time(0.4), matte.at_time(0.4))):
        times = times if a is glossy else torch.full((50,), 0.4)
        seen, expected = a(places, directions(50), times), b(places, places, times)
        assert torch.equal(seen.rgb, expected.rgb)
        assert torch.equal(seen.density, expected.density)


@pytest.mark.parametrize("degree", [1, 4])
def test_colour_follows_harmonics_of_the_direction_and_cosines_of_time_and_begins_matte(degree: int) -> None:
    """Before its activation colour is a sum of both; density sees no direction."""
    field, terms = small(temporal_terms=3, view_degree=degree).double(), (degree + 1) ** 2 + 2
    places, seen_from = torch.rand(20, 1, 3, dtype=torch.float64).expand(20, 60, 3), directions(60, torch.float64)
    seen_from, times = seen_from.expand(20, 60, 3), torch.rand(60, dtype=torch.float64).expand(20, 60)
    fresh = field(places, seen_from, times)
    torch.testing.assert_close(fresh.rgb, fresh.rgb[:, :1].expand_as(fresh.rgb), rtol=1e-12, atol=0)
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    values = torch.logit(field(places, seen_from, times).rgb)
    waves = torch.cos(torch.pi * torch.arange(3, dtype=torch.float64) * times[0, :, None])
    basis = torch.cat([waves, spherical_harmonics(seen_from[0], degree)[:, 1:]], dim=-1)
    found = torch.linalg.lstsq(basis[:terms].expand(20, -1, -1), values[:, :terms]).solution
    torch.testing.assert_close(basis @ found, values, rtol=0, atol=1e-7)  # conditions of some hundreds
    assert (found.abs().amax((0, 2)) > 1e-3).all()
    density = field.density(places, times)
    torch.testing.assert_close(density, field(places, -seen_from, times).density, rtol=1e-12, atol=0)


def test_one_colour_is_the_same_everywhere_while_density_differs_and_follows_time_and_direction() -> None:
    field = small(temporal_terms=3, view_degree=1, one_color=True)
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    places, seen_from = torch.rand(50, 3) + torch.tensor([0.0, 0.0, 3.0]), directions(2)
    first, later, aside = (
        field(places, direction.expand(50, 3), torch.full((50,), time))
        for time, direction in ((0.2, seen_from[0]), (0.9, seen_from[0]), (0.2, seen_from[1]))
    )
    assert float(first.density.detach().std()) > 1e-2
    for output in (first, later, aside):
        torch.testing.assert_close(output.rgb, output.rgb[:1].expand(50, 3))
    assert float((first.rgb - later.rgb)[0].detach().abs().max()) > 1e-2
    assert float((first.rgb - aside.rgb)[0].detach().abs().max()) > 1e-2
    first.rgb.sum().backward()
    assert field.head.output is not None
    assert not field.head.output.weight.grad.any()  # type: ignore[union-attr]
    assert field.head.output.bias.grad[3:].any()  # type: ignore[index]


@pytest.mark.parametrize(("box", "options", "message"), [
    ([[0, 0, 0], [1, 0, 1]], {}, "box must have finite corners"),
    (BOX, {"num_features": 0}, "num_features must be > 0"), (BOX, {"temporal_terms": 0}, "temporal_terms must be > 0"),
    (BOX, {"resolutions": ()}, "resolutions"), (BOX, {"view_degree": 5}, "view_degree must be one of 0, 1, 2, 3, 4"),
])  # fmt: skip
def test_bad_grids_are_refused(box: list, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GridField(box, **options)


def influence(field: GridField) -> list[float]:
    """How much each level's rows move the density."""
    times = torch.zeros(500)
    positions = torch.tensor(BOX)[0] + torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2
    (gradient,) = torch.autograd.grad(field.density(positions, times).sum(), field.table)
    rows = [level[3] for level in field.levels.describe()] + [len(gradient)]
    return [float(gradient[a:b].abs().sum()) for a, b in pairwise(rows)]


def test_finer_levels_fade_in_one_after_the_other() -> None:
    field = small(window_end=0.5)
    seen = []
    for progress in (0.0, 0.125, 0.25, 0.5, 1.0):
        field.set_progress(progress)
        seen.append(field.window.tolist())
        assert [i > 0 for i in influence(field)] == [w > 0 for w in field.window.tolist()]
    # (1 - cos(pi / 4)) / 2 a quarter of the way, 1 / 2 half way.
    expected = torch.tensor([[1, 0], [1, 0.14644661], [1, 0.5], [1, 1], [1, 1]])
    torch.testing.assert_close(torch.tensor(seen), expected, rtol=0, atol=1e-6)


def test_an_open_window_changes_nothing() -> None:
    windowed, plain = small(window_end=0.3), small()
    windowed.set_progress(1.0)
    plain.load_state_dict({name: value for name, value in windowed.state_dict().items() if name != "window"})
    positions, times = torch.rand(50, 3), torch.rand(50)
    assert torch.equal(windowed.density(positions, times), plain.density(positions, times))
    plain.set_progress(0.0)
    assert torch.equal(windowed.density(positions, times), plain.density(positions, times))


def test_the_window_is_saved_with_the_field() -> None:
    field, loaded = small(window_end=0.5), small(window_end=0.5)
    field.set_progress(0.2)
    loaded.load_state_dict(field.state_dict())
    assert torch.equal(loaded.window, field.window)
    assert "window" not in small().state_dict()


@pytest.mark.parametrize("end", [0.0, -1.0, 1.5])
def test_a_window_outside_the_training_is_refused(end: float) -> None:
    with pytest.raises(ValueError, match=r"window_end must be in \(0, 1\]"):
        small(window_end=end)


def test_what_depends_on_time_alone_is_summed_up_for_images() -> None:
    glossy = small(temporal_terms=3, view_degree=1).at_time(0.3)
    assert isinstance(glossy, GridFieldAtTime)
    assert glossy.weight.shape == (1 + 3 * 4, 16)
    frozen = small(temporal_terms=3).at_time(0.3)
    assert isinstance(frozen, GridFieldAtTime)
    assert frozen.weight.shape == (4, 16)  # of the head's sixteen to density and colour, not to 4 x 3 terms
    with pytest.raises(ValueError, match=r"times must all be 0\.3, got values from 0\.5 to 0\.5"):
        frozen.density(torch.zeros(4, 3), torch.full((4,), 0.5))


@pytest.mark.parametrize("options", [{}, {"view_degree": 2}, {"view_degree": 2, "one_color": True}])
def test_tables_for_the_frame_kernel_are_all_that_the_field_shows(options: dict) -> None:
    field = small(temporal_terms=3, window_end=1.0, **options)
    field.set_progress(0.6)
    torch.nn.init.normal_(field.head.output.weight)
    tables = field.at_time(0.3).network_tables()
    positions = torch.lerp(*torch.tensor(BOX), torch.rand(50, 3))
    unit = (positions - tables.low) * tables.scale
    raw = grid_network(unit, tables.table, tables.levels, tables.weights, tables.biases) + tables.shifts
    basis = spherical_harmonics(directions(50), options.get("view_degree", 0))
    colors = (raw[:, 1:].unflatten(1, (3, -1)) * basis[:, None]).sum(-1)
    density, rgb = shade(torch.cat([raw[:, :1], colors], dim=1), torch.zeros(4), 0.0)
    expected = field(positions, directions(50), torch.full((50,), 0.3))
    torch.testing.assert_close(density, expected.density, rtol=1e-4, atol=0)
    torch.testing.assert_close(rgb, expected.rgb, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("options", "part"), [
    ({"num_layers": 0}, "num_layers=0"),
    ({"space_time": PlaneFeatures(BOX, (4,), 3)}, "space_time features"),
])  # fmt: skip
def test_parts_that_the_frame_kernel_does_not_serve_are_named_once(
    options: dict, part: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_generic_path.cache_clear()
    for time in (0.3, 0.4):
        assert small(**options).at_time(time).network_tables() is None
    assert [part in record.message for record in caplog.records] == [True]


def test_what_is_no_level_is_seen_whatever_the_window() -> None:
    planes = PlaneFeatures(BOX, (4,), 3, num_features=2)
    positions = torch.rand(30, 3) + torch.tensor([0.0, 0.0, 3.0])
    field = small(window_end=1.0, space_time=planes)
    for table in planes.tables:
        torch.nn.init.normal_(table)
    field.set_progress(0.0)
    first, last = (field.density(positions, torch.full((30,), time)) for time in (0.1, 0.8))
    assert float((first - last).detach().abs().max()) > 1e-3


def test_levels_that_are_not_in_yet_are_not_seen() -> None:
    """Tables of closed levels neither show nor learn; half-open ones count half."""
    field = small(window_end=1.0)
    positions, times = torch.rand(50, 3) + torch.tensor([0.0, 0.0, 3.0]), torch.zeros(50)
    fine = field.levels.offsets[1]
    field.set_progress(0.5)
    assert 0.1 < float(field.window[1]) < 0.9
    half = field.density(positions, times)
    with torch.no_grad():
        field.table[fine:] *= field.window[1]
    field.set_progress(1.0)
    torch.testing.assert_close(field.density(positions, times), half)
    field.set_progress(0.0)
    field.density(positions, times).sum().backward()
    assert field.table.grad is not None
    assert not field.table.grad[fine:].any()
    assert field.table.grad[:fine].any()
    with torch.no_grad():
        closed = field.density(positions, times)
        field.table[fine:] = 7.0
        assert torch.equal(field.density(positions, times), closed)
