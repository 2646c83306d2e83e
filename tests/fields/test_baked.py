"""The lattice of bricks that stands in for a finished canonical field."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.compositing import FieldOutput
from dnerf.deformations import DisplacementDeformation, FrameLattice
from dnerf.fields import BakedField, Baking, DeformedField, GridField, RadianceField, SpaceTimeVolumes
from dnerf.kernels import use_backend
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5]]


class Smooth(RadianceField):
    """A field whose log-density and colours bend smoothly, and which counts what it is asked."""

    num_contents = 4
    num_points = 0

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self(positions, positions, times).density

    def contents(self, positions: Tensor) -> Tensor:
        self.num_points += positions.shape[:-1].numel()
        depth = 2 * torch.sin(2 * positions).sum(-1, keepdim=True)
        return torch.cat([depth, 0.5 + 0.5 * torch.sin(3 * positions)], dim=-1)

    def from_contents(self, contents: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(density=contents[..., 0].exp(), rgb=contents[..., 1:])

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return self.from_contents(self.contents(positions), times)


def points(count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    low, high = torch.tensor(BOX, dtype=dtype)
    return torch.lerp(low, high, unit)


def asked(field: RadianceField, positions: Tensor) -> FieldOutput:
    output = field(positions, positions, positions.new_zeros(len(positions)))
    assert isinstance(output, FieldOutput)
    return output


def errors(resolution: int) -> tuple[float, float]:
    field, x = Smooth(), points(3000)
    baked, exact = asked(Baking(BOX, resolution).bake(field), x), asked(field, x)
    return float((baked.density / exact.density).log().abs().max()), float((baked.rgb - exact.rgb).abs().max())


def test_error_falls_with_the_square_of_the_cells_and_stays_below_its_bound() -> None:
    found = {resolution: errors(resolution) for resolution in (8, 16, 32, 64)}
    rounding = 2.0**-11  # of half precision; logarithms are up to 6, colours up to 1
    for resolution, (depth, color) in found.items():
        square = (2 / resolution) ** 2 / 8  # linear interpolation of f errs by at most |f''| h^2 / 8 along each axis
        assert depth <= 3 * 8 * square + 6 * rounding
        assert color <= 4.5 * square + rounding
    for coarse, fine in ((8, 16), (16, 32)):
        assert all(a / b > 3.3 for a, b in zip(found[coarse], found[fine], strict=True))


def test_only_bricks_with_points_are_asked_and_once() -> None:
    field = Smooth()
    baked = Baking(BOX, 64).bake(field)
    x = torch.tensor([[0.3, 0.2, 0.1], [0.31, 0.21, 0.11], [-0.7, 0.0, 0.0]])
    asked(baked, x)
    assert baked.num_bricks == 2
    before = field.num_points
    again = asked(baked, x)
    assert field.num_points == before
    torch.testing.assert_close(again.density, asked(field, x).density, rtol=2e-2, atol=0)


def test_what_is_kept_does_not_depend_on_the_order_in_which_it_was_asked() -> None:
    torch.manual_seed(0)
    field = GridField(BOX, (8, 16), 4, hidden_features=16, num_layers=1)
    x = points(500, dtype=torch.float32)
    first, second = Baking(BOX, 48).bake(field), Baking(BOX, 48).bake(field)
    for i in reversed(range(0, 500, 100)):
        asked(second, x[i : i + 100])
    assert torch.equal(asked(first, x).density, asked(second, x).density)


def test_outside_the_box_the_field_itself_is_asked() -> None:
    field = Smooth()
    x = torch.cat([points(50), points(50) + torch.tensor([3.0, 0, 0])])
    output = asked(Baking(BOX, 32).bake(field), x)
    is_exact = (output.density / asked(field, x).density - 1).abs() < 1e-12
    assert is_exact.tolist() == [False] * 50 + [True] * 50


def test_any_shape_is_answered_and_nothing_is_nothing() -> None:
    baked = Baking(BOX, 16).bake(Smooth())
    output = baked(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3), torch.zeros(2, 3))
    assert output.density.shape == (2, 3)
    assert output.rgb.shape == (2, 3, 3)
    assert baked.density(torch.zeros(0, 3), torch.zeros(0)).shape == (0,)


def test_matter_that_changes_is_kept_for_all_times() -> None:
    torch.manual_seed(0)
    field = GridField(BOX, (4, 8), 2, hidden_features=16, num_layers=1, time_terms=3)
    for parameter in field.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    x, spread = points(300), torch.linspace(0, 1, 300, dtype=torch.float64)
    baked = Baking(BOX, 256).bake(field)
    colors = []
    for times in (torch.zeros(300, dtype=torch.float64), torch.full((300,), 0.7, dtype=torch.float64), spread):
        exact, kept = field.double()(x, x, times), baked(x, x, times)
        torch.testing.assert_close(kept.density, exact.density, rtol=5e-2, atol=0)
        torch.testing.assert_close(kept.rgb, exact.rgb, rtol=0, atol=2e-2)
        colors.append(kept.rgb)
    assert (colors[0] - colors[1]).abs().max() > 0.2


@pytest.mark.parametrize("options", [{"time_frequencies": 2}, {"view_degree": 2}])
def test_fields_that_change_are_not_baked(options: dict[str, Any]) -> None:
    field = GridField(BOX, (4,), 2, **options)
    with pytest.raises(ValueError, match="must have contents to keep, got a GridField"):
        Baking(BOX, 16).bake(field)
    model = DeformedField(DisplacementDeformation(1, 8, ()), field, baking=Baking(BOX, 16))
    assert model.finished() is model


@pytest.mark.parametrize(("name", "value"), [("resolution", 0), ("max_bricks", -1)])
def test_numbers_out_of_range_are_refused(name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"{name} must be"):
        Baking(BOX, **{name: value})


def test_sequences_show_the_same_pictures() -> None:
    torch.manual_seed(0)
    canonical = GridField(BOX, (8, 16), 4, hidden_features=16, num_layers=1, density_shift=1.0)
    with torch.no_grad():
        canonical.table.mul_(100)
    deformation = DisplacementDeformation(1, 16, (), position_frequencies=1, time_frequencies=1)
    field = DeformedField(deformation, canonical, frame_lattice=FrameLattice(BOX, 16), baking=Baking(BOX, 128))
    sampler = OccupancySampler(BOX, 0.05)
    renderer = Renderer(field, sampler, stop_transmittance=1e-3)
    assert renderer.for_sequence(60) is renderer  # there may be matter everywhere
    near = torch.zeros_like(sampler.occupied)
    near[:, 28:40, 28:40, 20:30] = True
    sampler.occupy(near)
    camera = Camera(Intrinsics.from_angle(24, 24, 0.7), look_at((3.0, 0.5, 1.0)), near=1.0, far=6.0)
    finished = renderer.for_sequence(60)
    assert isinstance(finished.field, DeformedField)
    assert isinstance(finished.field.canonical, BakedField)
    assert finished.field.frame_lattice is field.frame_lattice
    assert renderer.for_sequence(2) is renderer
    for time in (0.0, 0.5, 0.0):
        exact, baked = renderer.render_image(camera, time), finished.render_image(camera, time)
        assert float(exact.opacity.max()) > 0.5
        # Kinks of 16 cells lie on vertices of 128, so only the head bends between these.
        torch.testing.assert_close(baked.rgb, exact.rgb, rtol=0, atol=5e-3)
        assert not torch.equal(baked.rgb, exact.rgb)
    num_bricks = finished.field.canonical.num_bricks
    assert num_bricks > 10
    finished.render_image(camera, 0.5)
    assert finished.field.canonical.num_bricks == num_bricks


def test_modes_of_shared_parts_are_left_alone() -> None:
    field = DeformedField(DisplacementDeformation(1, 8, ()), GridField(BOX, (4,), 2), baking=Baking(BOX, 16))
    sampler = OccupancySampler(BOX, 0.05)
    sampler.occupy(torch.tensor(False))
    renderer = Renderer(field, sampler).train()
    sampler.eval()
    finished = renderer.for_sequence(60)
    assert finished is not renderer
    assert finished.training
    assert finished.field.training
    assert not sampler.training
    assert field.deformation.training


@pytest.mark.parametrize("time_terms", [1, 3])
def test_networks_in_bfloat16_are_baked_too(time_terms: int) -> None:
    torch.manual_seed(0)
    field = GridField(BOX, (8, 16), 4, hidden_features=16, num_layers=1, time_terms=time_terms)
    x = points(300, dtype=torch.float32)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        kept = Baking(BOX, 128).bake(field)
        baked, exact = asked(kept, x), asked(field, x)
        contents = kept.contents(x)
    assert torch.equal(baked.density, field.from_contents(contents, torch.tensor(0.0)).density)  # nothing is rounded
    assert baked.density.dtype == torch.float32
    # bfloat16 keeps 8 bits of logarithms of size 1.
    torch.testing.assert_close(baked.density, exact.density, rtol=2e-2, atol=0)
    torch.testing.assert_close(baked.rgb, exact.rgb, rtol=0, atol=1e-2)


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_places_that_are_none_are_asked_of_the_field(backend: str) -> None:
    x = torch.tensor([[0.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [0.0, math.inf, 0.0]])
    with use_backend(backend):
        density = asked(Baking(BOX, 16).bake(Smooth()), x).density
    assert density.isfinite().tolist() == [True, False, False]


def test_where_there_is_no_room_the_field_itself_is_asked_and_that_is_told_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    field, few = Smooth(), points(2)
    baked = Baking(BOX, 64, max_bricks=3).bake(field)
    kept = asked(baked, few).density
    assert baked.num_bricks == 2
    for seed in range(1, 4):
        many = points(20, seed)
        torch.testing.assert_close(asked(baked, many).density, asked(field, many).density)
    assert torch.equal(asked(baked, few).density, kept)
    assert not torch.equal(asked(field, few).density, kept)
    assert baked.num_bricks == 2
    assert [record.message for record in caplog.records] == [
        "baking: no room for more than 3 bricks, the field is asked itself"
    ]


def test_a_flat_box_has_a_brick() -> None:
    flat = Baking([[0.0, 0.0, 0.0], [1.0, 1.0, 1e-5]], 16).bake(Smooth())
    assert asked(flat, torch.zeros(2, 3)).density.isfinite().all()


def test_a_renderer_that_keeps_nothing_renders_sequences_itself() -> None:
    renderer = Renderer(Smooth(), OccupancySampler(BOX, 0.05))
    assert renderer.for_sequence(60) is renderer


def test_baked_fields_keep_nothing_that_is_saved() -> None:
    field = GridField(BOX, (4,), 2)
    baked = Baking(BOX, 16).bake(field)
    assert isinstance(baked, BakedField)
    assert set(baked.state_dict()) == {f"field.{name}" for name in field.state_dict()}


def test_contents_beyond_half_precision_stay_finite_and_no_number_stays_none() -> None:
    class Extreme(Smooth):
        def contents(self, positions: Tensor) -> Tensor:
            return super().contents(positions) * torch.tensor([1e6, 1.0, -1e30, torch.nan])

    values = Baking(BOX, 16).bake(Extreme()).contents(points(50, dtype=torch.float32))
    assert bool(values[:, :3].isfinite().all())
    assert bool(values[:, 3].isnan().all())


def test_a_field_with_more_to_say_answers_itself_and_its_contents_are_kept() -> None:
    torch.manual_seed(0)
    volumes = SpaceTimeVolumes(BOX, (4,), (4,), num_features=2)
    field = GridField(BOX, (8, 16), 4, hidden_features=16, time_terms=3, space_time=volumes)
    for table in volumes.tables:
        torch.nn.init.normal_(table)
    kept, x, times = Baking(BOX, 128).bake(field), points(200, dtype=torch.float32), torch.rand(200)
    with torch.no_grad():
        said, output = kept(x, x, times), field(x, x, times)
        assert torch.equal(said.density, output.density)
        assert torch.equal(said.rgb, output.rgb)
        assert torch.equal(kept.changes(x, times), field.changes(x, times))
        torch.testing.assert_close(kept.contents(x), field.contents(x), rtol=0, atol=2e-3)
    assert kept.has_changes
    assert kept.num_bricks > 0
