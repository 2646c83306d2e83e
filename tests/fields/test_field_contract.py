"""What every radiance field must do. A new one is one line in `FIELDS`."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, NeRFField, RadianceField, SpaceTimeVolumes


@dataclass(frozen=True)
class Case:
    """How to build a small field, whether its colour depends on the viewing direction, how many contents it has, and
    whether it has more to say."""

    make: Callable[[], RadianceField]
    view_dependent: bool = False
    num_contents: int = 0
    has_changes: bool = False


def small_nerf(view_dependent: bool = False, density_activation: str = "softplus") -> NeRFField:
    return NeRFField(
        3, 16, (1,), position_frequencies=4, view_dependent=view_dependent, direction_frequencies=2,
        density_activation=density_activation,
    )  # fmt: skip


def small_displacement() -> DisplacementDeformation:
    return DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=3)


def small_grid(time_frequencies: int | None = None, view_degree: int | None = None, time_terms: int = 1) -> GridField:
    return GridField(
        [[-1, -1.5, -1], [1, 1.5, 2]], (4, 9), 2, max_rows=64, hidden_features=16, num_layers=1,
        time_frequencies=time_frequencies, view_degree=view_degree, time_terms=time_terms,
    )  # fmt: skip


def small_space_time(view_degree: int | None = None) -> GridField:
    box = [[-1, -1.5, -1], [1, 1.5, 2]]
    volumes = SpaceTimeVolumes(box, (4, 8), (3, 5), num_features=2)
    return GridField(
        box, (4, 9), 2, max_rows=64, hidden_features=16, num_layers=1, time_terms=3, space_time=volumes,
        view_degree=view_degree,
    )  # fmt: skip


FIELDS = {
    "nerf": Case(small_nerf, num_contents=4),
    "nerf, exp density": Case(lambda: small_nerf(density_activation="exp"), num_contents=4),
    "nerf, view-dependent": Case(lambda: small_nerf(view_dependent=True), view_dependent=True),
    "grid": Case(small_grid, num_contents=4),
    "grid, changing": Case(lambda: small_grid(time_terms=3), num_contents=12),
    "grid, changing and view-dependent": Case(lambda: small_grid(view_degree=2, time_terms=3), True),
    "grid, space-time": Case(small_space_time, num_contents=12, has_changes=True),
    "grid, space-time and view-dependent": Case(lambda: small_space_time(2), True),
    "grid, timed and view-dependent": Case(lambda: small_grid(time_frequencies=3, view_degree=2), True),
    "static": Case(lambda: DeformedField(IdentityDeformation(), small_nerf())),
    "deformed": Case(lambda: DeformedField(small_displacement(), small_nerf())),
    "deformed, view-dependent": Case(lambda: DeformedField(small_displacement(), small_nerf(True)), True),
}

every_field = pytest.mark.parametrize("name", FIELDS)
VIEW_INDEPENDENT = [name for name, case in FIELDS.items() if not case.view_dependent]
VIEW_DEPENDENT = [name for name, case in FIELDS.items() if case.view_dependent]


def trained(name: str, dtype: torch.dtype = torch.float32) -> RadianceField:
    """A field away from its initialisation, as training would leave it."""
    field = FIELDS[name].make().to(dtype)
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator, dtype=dtype)
    return field


def some_points(*batch: int, dtype: torch.dtype = torch.float32, scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, unit directions and times."""
    generator = torch.Generator().manual_seed(4)
    positions, directions = torch.randn((2, *batch, 3), generator=generator, dtype=dtype)
    times = torch.rand(batch, generator=generator, dtype=dtype)
    return scale * positions, torch.nn.functional.normalize(directions, dim=-1), times


@every_field
@pytest.mark.parametrize("batch", [(), (7,), (2, 5), (0,), (3, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_output_has_the_shape_and_dtype_of_the_points(name: str, batch: tuple[int, ...], dtype: torch.dtype) -> None:
    output = trained(name, dtype)(*some_points(*batch, dtype=dtype))
    assert output.density.shape == batch
    assert output.rgb.shape == (*batch, 3)
    assert output.density.dtype == output.rgb.dtype == dtype


@every_field
@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_density_is_not_negative_and_colours_are_colours(name: str, scale: float) -> None:
    output = trained(name)(*some_points(500, scale=scale))
    assert torch.isfinite(output.density).all()
    assert (output.density >= 0).all()
    assert (output.rgb >= 0).all()
    assert (output.rgb <= 1).all()


@every_field
def test_density_alone_equals_that_of_the_whole_output(name: str) -> None:
    field = trained(name)
    positions, directions, times = some_points(100)
    assert torch.equal(field.density(positions, times), field(positions, directions, times).density)


@every_field
def test_the_field_of_one_time_is_the_field_at_that_time(name: str) -> None:
    field = trained(name, torch.float64)
    positions, directions, times = some_points(100, dtype=torch.float64)
    for time in (0.0, 0.37, 1.0):
        times.fill_(time)
        with torch.no_grad():
            expected, frozen = field(positions, directions, times), field.at_time(time)
        output = frozen(positions, directions, times)
        torch.testing.assert_close(output.density, expected.density, rtol=1e-9, atol=0)
        torch.testing.assert_close(output.rgb, expected.rgb, rtol=1e-9, atol=0)
        torch.testing.assert_close(frozen.density(positions, times), expected.density, rtol=1e-9, atol=0)


@pytest.mark.parametrize("name", VIEW_INDEPENDENT)
def test_view_independent_fields_ignore_directions(name: str) -> None:
    field = trained(name)
    positions, directions, times = some_points(50)
    directions.requires_grad_()
    rgb = field(positions, directions, times).rgb
    assert torch.equal(rgb, field(positions, -directions.flip(0), times).rgb)
    assert torch.autograd.grad(rgb.sum(), directions, allow_unused=True) == (None,)
    assert not [key for key, _ in field.named_parameters() if "direction" in key]


@pytest.mark.parametrize("name", VIEW_DEPENDENT)
def test_view_dependent_fields_change_colour_and_not_density(name: str) -> None:
    field = trained(name)
    positions, directions, times = some_points(50)
    here, there = field(positions, directions, times), field(positions, -directions, times)
    assert not torch.allclose(here.rgb, there.rgb, atol=1e-4)
    assert torch.equal(here.density, there.density)


@every_field
def test_gradients_reach_every_parameter_and_are_finite(name: str) -> None:
    field = trained(name)
    positions, directions, times = some_points(200)
    positions.requires_grad_()
    output = field(positions, directions, times)
    (output.density.sum() + output.rgb.square().sum()).backward()
    assert torch.isfinite(positions.grad).all()
    for key, parameter in field.named_parameters():
        assert parameter.grad is not None, key
        assert torch.isfinite(parameter.grad).all(), key
        assert torch.count_nonzero(parameter.grad) > 0, key


@every_field
def test_gradients_are_alive_at_the_start(name: str) -> None:
    """No dead start: density is positive somewhere to begin with, and every layer of the trunk learns."""
    field = FIELDS[name].make()
    output = field(*some_points(200))
    assert (output.density > 0).all()
    # Thin at the start, or every picture is a wall: below 1 / world unit on average.
    assert output.density.mean() < 1
    (output.density.sum() + output.rgb.sum()).backward()
    assert all(torch.isfinite(p.grad).all() for p in field.parameters() if p.grad is not None)


@every_field
def test_gradcheck_to_positions(name: str) -> None:
    field = trained(name, torch.float64)
    positions, directions, times = some_points(3, dtype=torch.float64, scale=0.1)

    def outputs(positions: Tensor) -> tuple[Tensor, Tensor]:
        output = field(positions, directions, times)
        return output.density, output.rgb

    # A ReLU's kink within a finite difference of 1e-7 is unlikely, with the fixed seed absent.
    assert torch.autograd.gradcheck(outputs, (positions.requires_grad_(),), eps=1e-7, atol=1e-5)


@every_field
def test_mixed_times_equal_one_time_after_the_other(name: str) -> None:
    field = trained(name, torch.float64)
    positions, directions, times = some_points(6, dtype=torch.float64)
    together = field(positions, directions, times)
    for i in range(6):
        alone = field(positions[i], directions[i], times[i])
        # Matrix products of other sizes round differently.
        torch.testing.assert_close(together.density[i], alone.density, rtol=1e-11, atol=0)
        torch.testing.assert_close(together.rgb[i], alone.rgb, rtol=1e-11, atol=0)


@every_field
def test_bfloat16_autocast_is_close_to_float32(name: str) -> None:
    field = trained(name)
    points = some_points(300, scale=0.2)
    exact = field(*points)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = field(*points)
        density = field.density(points[0], points[2])
    assert output.density.dtype == output.rgb.dtype == density.dtype == torch.float32
    # A digit of bfloat16 is 2^-8; some layers of it, on outputs of size one.
    torch.testing.assert_close(output.density, exact.density, rtol=0.05, atol=0.02)
    torch.testing.assert_close(output.rgb, exact.rgb, rtol=0, atol=0.03)
    # Equal to that of the whole output also here.
    torch.testing.assert_close(output.density, density, rtol=0, atol=0)


@every_field
def test_field_is_deterministic(name: str) -> None:
    field = trained(name)
    points = some_points(30)
    first = field(*points)
    second = field.eval()(*points)
    assert torch.equal(first.density, second.density)
    assert torch.equal(first.rgb, second.rgb)


@every_field
@pytest.mark.parametrize("shape", [(4, 1), (), (1,), (5,)])
def test_times_of_another_shape_are_named(name: str, shape: tuple[int, ...]) -> None:
    field = FIELDS[name].make()
    message = f"times must have shape (4,), got {shape}"
    with pytest.raises(ValueError) as error:
        field(torch.zeros(4, 3), torch.ones(4, 3), torch.zeros(shape))
    assert str(error.value) == message
    with pytest.raises(ValueError) as error:
        field.density(torch.zeros(4, 3), torch.zeros(shape))
    assert str(error.value) == message


@pytest.mark.parametrize("name", VIEW_DEPENDENT)
@pytest.mark.parametrize("shape", [(4, 2), (3,), (5, 3), (1, 3)])
def test_directions_of_another_shape_are_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError) as error:
        FIELDS[name].make()(torch.zeros(4, 3), torch.ones(shape), torch.zeros(4))
    assert str(error.value) == f"directions must have shape (4, 3), got {shape}"


@every_field
def test_contents_say_all_that_the_field_says(name: str) -> None:
    field = trained(name)
    positions, directions, times = some_points(4, 9)
    assert field.num_contents == FIELDS[name].num_contents
    assert field.has_changes == FIELDS[name].has_changes
    if not field.num_contents:
        for ask in (lambda: field.contents(positions), lambda: field.from_contents(positions, times)):
            with pytest.raises(ValueError, match="has no contents"):
                ask()
        return
    contents = field.contents(positions)
    assert contents.shape == (4, 9, field.num_contents)
    if field.has_changes:
        return
    said, output = field.from_contents(contents, times), field(positions, directions, times)
    assert torch.equal(said.density, output.density)
    assert torch.equal(said.rgb, output.rgb)
    moment = torch.tensor(0.3)
    one, same = field.from_contents(contents, moment), field(positions, directions, moment.expand(4, 9))
    torch.testing.assert_close(one.density, same.density)
    torch.testing.assert_close(one.rgb, same.rgb)


@pytest.mark.parametrize("name", [name for name, case in FIELDS.items() if case.num_contents])
def test_contents_that_do_not_fit_are_refused(name: str) -> None:
    field, contents = trained(name), torch.zeros(5, FIELDS[name].num_contents)
    with pytest.raises(ValueError, match="positions must"):
        field.contents(torch.zeros(5, 1))
    with pytest.raises(ValueError, match="contents must have shape"):
        field.from_contents(torch.zeros(5, 7), torch.zeros(5))
    with pytest.raises(ValueError, match=r"times must have shape \(\) or \(5,\)"):
        field.from_contents(contents, torch.zeros(5, 1))


@every_field
def test_contents_add_up_as_the_field_says(name: str) -> None:
    field = trained(name)
    series = field.series_at(0.3)
    if series is None:
        assert not isinstance(field, GridField) or not field.num_contents
        return
    positions, directions, _ = some_points(4, 9)
    waves, shift = series
    terms, moments = field.contents(positions).unflatten(-1, (4, len(waves))) @ waves, torch.full((4, 9), 0.3)
    if field.has_changes:
        changes = field.changes(positions, moments)
        assert changes.abs().max() > 1e-3
        terms = terms + changes
    output = field(positions, directions, moments)
    torch.testing.assert_close(output.density, torch.exp((terms[..., 0] + shift).clamp(max=15)), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(output.rgb, torch.sigmoid(terms[..., 1:]), rtol=1e-5, atol=1e-6)


@every_field
def test_changes_of_a_field_without_or_of_shapes_that_do_not_fit_are_refused(name: str) -> None:
    field = trained(name)
    message = "times must" if field.has_changes else "has no changes beside its contents"
    with pytest.raises(ValueError, match=message):
        field.changes(torch.zeros(5, 3), torch.zeros(5, 1))
