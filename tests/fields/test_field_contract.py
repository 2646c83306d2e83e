"""What every radiance field must do. A new one is one line in `FIELDS`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.deformations import DisplacementDeformation, IdentityDeformation
from dnerf.fields import (
    AmbientCoordinates,
    DeformedField,
    GridField,
    NeRFField,
    NeuSField,
    PlaneFeatures,
    PlanesField,
    RadianceField,
    SDFField,
    VolSDFField,
    VoxelField,
)
from dnerf.fields.base import TimeDependence, field_at_time


@dataclass(frozen=True)
class Case:
    """How to build a small field, and whether its colour depends on the viewing direction."""

    make: Callable[[], RadianceField]
    view_dependent: bool = False


def small_nerf(view_dependent: bool = False, density_activation: str = "softplus") -> NeRFField:
    return NeRFField(
        3, 16, (1,), position_frequencies=4, view_dependent=view_dependent, direction_frequencies=2,
        density_activation=density_activation,
    )  # fmt: skip


def small_displacement() -> DisplacementDeformation:
    return DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=3)


def small_grid(**options: Any) -> GridField:
    box = [[-1, -1.5, -1], [1, 1.5, 2]]
    return GridField(box, (4, 9), 2, max_rows=64, hidden_features=16, num_layers=1, **options)


def small_planes(num_times: int | None = 3, view_degree: int | None = None, join: str = "product") -> PlanesField:
    planes = PlaneFeatures([[-1, -1.5, -1], [1, 1.5, 2]], (4, 9), num_times, num_features=2, join=join)
    return PlanesField(planes, hidden_features=16, num_layers=1, view_degree=view_degree)


def small_ambient(view_degree: int | None = None) -> GridField:
    ambient = AmbientCoordinates(2, hidden_features=16, num_layers=1)
    ambient.encode.set_progress(1.0)
    return small_grid(space_time=ambient, view_degree=view_degree)


def small_sdf(kind: type[SDFField], view_degree: int | None = None) -> SDFField:
    box = [[-1, -1.5, -1], [1, 1.5, 2]]
    options = {"max_rows": 64, "hidden_features": 16, "num_layers": 1, "view_degree": view_degree}
    return kind(box, (4, 9), 2, **options, radius=0.5, width=0.3)


FIELDS = {
    "nerf": Case(small_nerf), "nerf, exp density": Case(lambda: small_nerf(density_activation="exp")),
    "nerf, view-dependent": Case(lambda: small_nerf(view_dependent=True), view_dependent=True),
    "grid": Case(small_grid), "grid, changing": Case(lambda: small_grid(temporal_terms=3)),
    "grid, changing and view-dependent": Case(lambda: small_grid(view_degree=2, temporal_terms=3), True),
    "grid, ambient and view-dependent": Case(lambda: small_ambient(2), True),
    "grid, view-dependent": Case(lambda: small_grid(view_degree=2), True),
    "planes": Case(small_planes), "planes of space": Case(lambda: small_planes(None)),
    "planes, view-dependent": Case(lambda: small_planes(3, 2), True), "grid, ambient": Case(small_ambient),
    "planes in pairs": Case(lambda: small_planes(join="pairs")),
    "voxels": Case(lambda: VoxelField([[-1, -1.5, -1], [1, 1.5, 2]], (4, 9), view_resolution=4), True),
    "sdf, NeuS": Case(lambda: small_sdf(NeuSField)), "sdf, VolSDF": Case(lambda: small_sdf(VolSDFField)),
    "sdf, view-dependent": Case(lambda: small_sdf(NeuSField, 2), True),
    "static": Case(lambda: DeformedField(IdentityDeformation(), small_nerf())),
    "deformed": Case(lambda: DeformedField(small_displacement(), small_nerf())),
    "deformed, view-dependent": Case(lambda: DeformedField(small_displacement(), small_nerf(True)), True),
}  # fmt: skip

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
    # Matrix products of other sizes round differently: a field may know density by less than it has to colour.
    alone, whole = field.density(positions, times), field(positions, directions, times).density
    torch.testing.assert_close(alone, whole, rtol=1e-6 if name in VIEW_DEPENDENT else 0, atol=0)


@every_field
def test_the_field_of_one_time_is_the_field_at_that_time(name: str) -> None:
    field = trained(name, torch.float64)
    positions, directions, times = some_points(100, dtype=torch.float64)
    for time in (0.0, 0.37, 1.0):
        times.fill_(time)
        with torch.no_grad():
            expected, frozen = field(positions, directions, times), field_at_time(field, time)
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
    # Thin at the start, or every image is a wall: below 1 / world unit on average.
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
    # Equal to that of the whole output also here, but where matrix products of other sizes round differently.
    torch.testing.assert_close(output.density, density, rtol=0.01 if name in VIEW_DEPENDENT else 0, atol=0)


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
def test_a_field_that_says_it_is_static_is(name: str) -> None:
    field = trained(name)
    if not isinstance(field, TimeDependence):
        return
    positions, directions, times = some_points(50)
    first, last = (field(positions, directions, t) for t in (times, 1 - times))
    assert field.is_static == (torch.equal(first.density, last.density) and torch.equal(first.rgb, last.rgb))


class Grey(GridField):
    """A grid field whose colour is another one: what images show, too."""

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return replace(super().forward(positions, directions, times), rgb=torch.full_like(positions, 0.25))


class Half(GridField):
    """A grid field of half the density."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return 0.5 * super().density(positions, times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        output = super().forward(positions, directions, times)
        return replace(output, density=0.5 * output.density)


class Same(GridField):
    """A grid field by another name, whose shortcut holds."""


@pytest.mark.parametrize("kind", [Grey, Half])
def test_overrides_of_subclasses_hold_for_the_field_of_one_time(kind: type[GridField]) -> None:
    box, (positions, directions, times) = [[-2.0] * 3, [2.0] * 3], some_points(50)
    times.fill_(0.3)
    grid = kind(box, (4, 9), 2, temporal_terms=3)
    for field in (grid, DeformedField(IdentityDeformation(), grid), DeformedField(small_displacement(), grid)):
        frozen, expected = field_at_time(field, 0.3), field(positions, directions, times)
        assert torch.equal(frozen(positions, directions, times).rgb, expected.rgb)
        assert torch.equal(frozen.density(positions, times), expected.density)
    assert field_at_time(grid, 0.3) is grid
    same = Same(box, (4, 9), 2)
    assert field_at_time(same, 0.3) is not same
