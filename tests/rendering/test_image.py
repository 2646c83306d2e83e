"""Images by one fused kernel and by the generic path show the same, and what subclasses say is in both."""

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import pytest
import torch
from reference import occupancy_sampler, soft_ball
from torch import Tensor

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput, Rendering
from dnerf.core.rays import Rays, Samples
from dnerf.deformations import CachedDeformation, DisplacementDeformation, IdentityDeformation
from dnerf.deformations.cached import CachedAtTime
from dnerf.fields import DeformedField, GridField, PlaneFeatures, RadianceField
from dnerf.fields.base import warn_of_generic_path
from dnerf.kernels.trace_network import trace_network
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import OccupancySampler, Sampler, StratifiedSampler

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
CAMERA = Camera(Intrinsics(32, 24, 30.0, 30.0), look_at([0.3, -3.2, 0.8], [0.0, 0.0, 0.0]))


def model(
    *, subdivision: int = 1, stop: float = 1e-4, box: list | None = None, cells: int = 24,
    precision: str = "bfloat16", canonical: type[GridField] = GridField,
    sampler: type[OccupancySampler] = OccupancySampler, **options: object,
) -> Renderer:  # fmt: skip
    """A random body in the middle of the box, moved a little."""
    torch.manual_seed(0)
    settings = {"temporal_terms": 3, "hidden_features": 16, "density_shift": 2.0, **options}
    grid = canonical(BOX, (4, 9), 4, **settings)  # type: ignore[arg-type]
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2, canonical_time=None)
    with torch.no_grad():
        grid.table.mul_(150)
        for parameter in grid.head.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
        deformation.mlp.output.weight.add_(0.03 * torch.randn_like(deformation.mlp.output.weight))
    occupancy = occupancy_sampler(
        BOX, 0.03 * subdivision, 16, kind=sampler, num_slabs=4, subdivision=subdivision, subdivision_weight=0.02,
        dilation=0, pad_to=64,
    )  # fmt: skip
    mask = torch.zeros(16, 16, 16, dtype=torch.bool)
    mask[5:11, 5:11, 4:12] = True
    occupancy.grid.occupy(mask)
    field = DeformedField(CachedDeformation(deformation, box or BOX, cells), grid)
    return Renderer(field, occupancy, stop_transmittance=stop, precision=precision).eval()


def image(renderer: Renderer, time: float = 0.3) -> Tensor:
    """Colour, opacity and depth (H, W, 5)."""
    shown = renderer.render_image(CAMERA, time)
    return torch.cat([shown.rgb, shown.opacity[..., None], shown.depth[..., None]], dim=-1)


def generic(renderer: Renderer, time: float = 0.3) -> Tensor:
    """The image by rounds of samples."""
    with patch("dnerf.rendering.image.fused_path", return_value=None):
        return image(renderer, time)


@pytest.fixture
def fused(monkeypatch: pytest.MonkeyPatch) -> list[Tensor]:
    """Of which rays (R,) the kernel, if it was used, came to their end."""
    # These images are small: all displacements around occupied cells are few for larger ones.
    monkeypatch.setattr("dnerf.deformations.cached.VERTICES_PER_RAY", 100)
    done: list[Tensor] = []

    def traced(*arguments: object, **options: object) -> tuple[Tensor, Tensor]:
        states, is_done = trace_network(*arguments, **options)  # type: ignore[arg-type]
        done.append(is_done)
        return states, is_done

    monkeypatch.setattr("dnerf.rendering.image.trace_network", traced)
    return done


@pytest.mark.parametrize("options", [
    {"temporal_terms": 1}, {}, {"view_degree": 2}, {"temporal_terms": 1, "view_degree": 4},
])  # fmt: skip
@pytest.mark.parametrize("subdivision", [1, 3])
@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
def test_the_fused_kernel_shows_what_the_generic_path_shows(
    options: dict, subdivision: int, precision: str, fused: list[Tensor]
) -> None:
    renderer = model(subdivision=subdivision, precision=precision, **options)
    expected = generic(renderer)
    assert not fused
    shown = image(renderer)
    assert torch.cat(fused).all()
    assert (expected[..., 3] > 0.9).any()
    assert (expected[..., 3] == 0).any()
    assert expected[..., :3].std() > 0.05
    # Rounding decides whether what hardly counts is left out; depths are of pixels with some opacity.
    torch.testing.assert_close(shown[..., :4], expected[..., :4], rtol=0, atol=3e-3)
    is_there = expected[..., 3] > 0.1
    torch.testing.assert_close(shown[is_there], expected[is_there], rtol=0, atol=2e-2)
    assert torch.equal(image(renderer), shown)
    assert torch.equal(renderer.render_image(CAMERA, 0.3, chunk=100).rgb, shown[..., :3])


@pytest.mark.parametrize("subdivision", [1, 3])
def test_what_nothing_moves_is_rendered_by_the_kernel_too(subdivision: int, fused: list[Tensor]) -> None:
    renderer = model(subdivision=subdivision)
    still, field = IdentityDeformation(), renderer.field
    shown = []
    for deformation in (still, CachedDeformation(still, BOX, 24)):
        renderer.field = DeformedField(deformation, field.canonical).eval()  # type: ignore[union-attr,arg-type]
        shown.append(image(renderer))
        assert torch.cat(fused).all()
        torch.testing.assert_close(shown[-1][..., :4], generic(renderer)[..., :4], rtol=0, atol=3e-3)
    assert len(fused) == 2
    assert torch.equal(*shown)


def test_rays_that_the_kernel_cannot_follow_are_rendered_all_the_same(fused: list[Tensor]) -> None:
    small = model(box=[[-0.2, -0.2, -0.2], [0.2, 0.2, 0.2]], cells=12)
    torch.testing.assert_close(image(small)[..., :4], generic(small)[..., :4], rtol=0, atol=3e-3)
    assert not torch.cat(fused).all()


def test_the_kernel_is_used_only_for_what_it_was_made_for(fused: list[Tensor]) -> None:
    planes = PlaneFeatures(BOX, (3,), 2, num_features=2)
    for renderer in (model(space_time=planes), model(stop=0.0)):
        image(renderer)
    assert not fused


@pytest.mark.parametrize(("options", "part"), [
    ({"space_time": PlaneFeatures(BOX, (3,), 2, num_features=2)}, "space_time features"),
    ({"hidden_features": 12}, r"layers of widths [8, 12, 12, 4]"),
])  # fmt: skip
def test_parts_that_keep_a_model_from_the_kernel_are_named(
    options: dict, part: str, fused: list[Tensor], caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_generic_path.cache_clear()
    renderer = model(**options)
    for _ in range(2):
        image(renderer)
    assert [part in record.message for record in caplog.records] == [True]
    assert not fused


def test_another_canonical_field_is_named(fused: list[Tensor], caplog: pytest.LogCaptureFixture) -> None:
    warn_of_generic_path.cache_clear()
    image(model(canonical=Grey))
    assert ["a canonical Grey" in record.message for record in caplog.records] == [True]


def test_what_is_filled_ahead_changes_nothing(fused: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    counts: list[int] = []
    fill = CachedAtTime.fill

    def counted(self: CachedAtTime, places: Tensor) -> bool:
        counts.append(len(places))
        return fill(self, places)

    monkeypatch.setattr(CachedAtTime, "fill", counted)
    ahead = image(model(subdivision=3))
    assert counts[0] > 0.9 * sum(counts)
    counts.clear()
    monkeypatch.setattr("dnerf.deformations.cached.VERTICES_PER_RAY", 0)  # rays find what they need
    torch.testing.assert_close(image(model(subdivision=3))[..., :4], ahead[..., :4], rtol=0, atol=3e-3)
    assert len(fused) == 1
    assert len(counts) > 1


@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
def test_frames_do_not_depend_on_those_before(precision: str, fused: list[Tensor]) -> None:
    renderer, alone = model(precision=precision), image(model(precision=precision), 0.8)
    image(renderer, 0.1)
    for _ in range(2):
        assert torch.equal(image(renderer, 0.8), alone)


@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
@pytest.mark.parametrize("subdivision", [1, 3])
def test_nan_is_shown_not_hidden(subdivision: int, precision: str, fused: list[Tensor]) -> None:
    for part in ("deformation", "canonical"):
        renderer = model(subdivision=subdivision, precision=precision)
        with torch.no_grad():
            for parameter in getattr(renderer.field, part).parameters():
                parameter.fill_(torch.nan)
        for path in (image, generic):
            assert path(renderer).isnan().any()
    assert fused


class Grey(GridField):
    """Its colour is another one."""

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return replace(super().forward(positions, directions, times), rgb=torch.full_like(positions, 0.25))


class GreyDeformed(DeformedField):
    """So is that of this one."""

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return replace(super().forward(positions, directions, times), rgb=torch.full_like(positions, 0.25))


class Still(CachedDeformation):
    """Moves nothing."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions


class FrontOnly(OccupancySampler):
    """Leaves out what lies behind 0.3 of each ray."""

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return super().forward(replace(rays, far=torch.lerp(rays.near, rays.far, 0.3)), field, generator=generator)


class Dimmed(Renderer):
    """Shows half of the light."""

    def forward(self, rays: Rays, **options: object) -> Rendering:
        shown = super().forward(rays, **options)  # type: ignore[arg-type]
        return replace(shown, rgb=0.5 * shown.rgb)


def deformed_by(kind: type[DeformedField]) -> Renderer:
    renderer = model()
    renderer.field = kind(renderer.field.deformation, renderer.field.canonical)  # type: ignore[union-attr,arg-type]
    return renderer.eval()


def still() -> Renderer:
    renderer = model()
    inner = renderer.field.deformation.deformation  # type: ignore[union-attr]
    renderer.field.deformation = Still(inner, BOX, 24)  # type: ignore[arg-type]
    return renderer.eval()


def dimmed() -> Renderer:
    plain = model()
    return Dimmed(plain.field, plain.sampler, stop_transmittance=1e-4, precision="bfloat16").eval()


def grey_grid() -> Renderer:
    plain = model(canonical=Grey)
    return Renderer(plain.field.canonical, plain.sampler, stop_transmittance=1e-4).eval()  # type: ignore[union-attr,arg-type]


OVERRIDDEN: dict[str, Callable[[], Renderer]] = {
    "canonical field": lambda: model(canonical=Grey), "field": grey_grid,
    "deformed field": lambda: deformed_by(GreyDeformed), "deformation": still,
    "sampler": lambda: model(sampler=FrontOnly), "renderer": dimmed,
}  # fmt: skip


@pytest.mark.parametrize("name", OVERRIDDEN)
def test_overrides_of_subclasses_are_honoured_in_images(name: str, fused: list[Tensor]) -> None:
    """Training renders rays by the renderer itself; images show the same, the cut-off for each interval aside."""
    renderer = OVERRIDDEN[name]()
    rays = renderer(CAMERA.rays(0.3))
    expected = torch.cat([rays.rgb, rays.opacity[:, None]], dim=-1).reshape(24, 32, 4)
    plain = image(model())[..., :4]
    assert (expected - plain).abs().max() > 0.1
    # Displacements of a lattice are those of its corners, interpolated.
    torch.testing.assert_close(image(renderer)[..., :4], expected, rtol=0, atol=0.02)
    assert (image(renderer)[..., :4] - expected).abs().mean() < 1e-3


def test_overrides_of_backgrounds_are_honoured_where_nothing_is() -> None:
    class Sky(ConstantBackground):
        def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
            return 0.5 + 0.5 * rays.directions

    renderer = model()
    renderer.background = Sky()
    rays = CAMERA.rays(0.3)
    empty = image(renderer)[..., 3].flatten() == 0
    expected = 0.5 + 0.5 * rays.directions[empty]
    torch.testing.assert_close(image(renderer)[..., :3].reshape(-1, 3)[empty], expected)


def test_samplers_whose_forward_is_overridden_have_no_fixed_capacity() -> None:
    with pytest.raises(ValueError, match="graphs needs a sampler with a fixed capacity, got FrontOnly"):
        Renderer(soft_ball(), occupancy_sampler(BOX, kind=FrontOnly), graphs=True)


SAMPLERS: dict[str, Callable[[], Sampler]] = {
    "occupancy": lambda: occupancy_sampler(BOX, 0.05, 16),
    "stratified": lambda: StratifiedSampler(32, BOX),
}


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("model_dtype", [torch.float32, torch.float64, None])
@pytest.mark.parametrize("pose_dtype", [torch.float32, torch.float64])
def test_poses_of_either_precision_are_taken(
    sampler: str, model_dtype: torch.dtype | None, pose_dtype: torch.dtype
) -> None:
    """A model of parameters has its images in their precision, with lattices too; one of none in the pose's."""
    camera = replace(CAMERA, pose=CAMERA.pose.to(pose_dtype))
    if model_dtype is None:
        renderer = Renderer(soft_ball(), SAMPLERS[sampler]())
        expected = Renderer(soft_ball(), SAMPLERS[sampler]()).render_image(CAMERA, 0.3).rgb
    else:
        field = model().field
        renderer = Renderer(field, SAMPLERS[sampler]()).to(model_dtype)
        expected = Renderer(model().field, SAMPLERS[sampler]()).render_image(CAMERA, 0.3).rgb
    shown = renderer.render_image(camera, 0.3)
    assert shown.rgb.dtype == shown.depth.dtype == (model_dtype or pose_dtype)
    torch.testing.assert_close(shown.rgb.float(), expected, rtol=0, atol=1e-4)


def test_the_generic_path_fills_a_frame_s_displacements_at_once(fused: list[Tensor]) -> None:
    renderer = model(hidden_features=12, subdivision=3)  # which the kernel does not serve
    with patch.object(CachedAtTime, "_evaluated", autospec=True, side_effect=CachedAtTime._evaluated) as rounds:
        image(renderer)
    assert not fused
    assert rounds.call_count == 1
