"""The renderer: the same pixel whatever the chunk, the batch and the precision."""

import math

import pytest
import torch
from reference import composite_ray, fog, rays_towards_origin, soft_ball
from torch import Tensor, nn

from dnerf.backgrounds import Background, ConstantBackground, RandomBackground
from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.compositing import FieldOutput, Rendering, composite
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, NeRFField, RadianceField
from dnerf.rays import Rays, Samples
from dnerf.renderer import Renderer
from dnerf.samplers import ImportanceSampler, OccupancySampler, StratifiedSampler


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def trained_field() -> RadianceField:
    """A small dynamic field with dense, coloured matter, as training would leave it."""
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2)
    field = DeformedField(deformation, NeRFField(2, 16, (), position_frequencies=3, view_dependent=True))
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.2 * torch.randn(parameter.shape, generator=seeded(parameter.numel()))
    return field


def some_camera(width: int = 7, height: int = 5) -> Camera:
    return Camera(Intrinsics.from_angle(width, height, 0.7), look_at((2, 2, 1.5)), 1.0, 5.0)


class Sky(Background):
    """A colour for each direction."""

    def forward(self, directions: Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        return 0.5 + 0.5 * directions


SAMPLERS = {"stratified": lambda: StratifiedSampler(16), "importance": lambda: ImportanceSampler(12, 12, soft_ball())}
both_samplers = pytest.mark.parametrize("sampler", SAMPLERS)


def test_rays_through_fog_have_their_closed_form() -> None:
    rays = rays_towards_origin(10, torch.float64)
    rendering = Renderer(fog(0.3), StratifiedSampler(8), ConstantBackground([0.2, 0.4, 0.6])).eval()(rays)
    opacity = -math.expm1(-0.3 * 4)
    fog_color = torch.stack([rays.times, torch.full_like(rays.times, 0.5), torch.ones_like(rays.times)], -1)
    # The background's colour is kept in float32.
    expected = opacity * fog_color + (1 - opacity) * torch.tensor([0.2, 0.4, 0.6], dtype=torch.float64)
    torch.testing.assert_close(rendering.rgb, expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(rendering.opacity, torch.full_like(rays.times, opacity), rtol=1e-12, atol=0)


def test_rays_agree_with_a_loop_over_samples() -> None:
    field, sampler = trained_field(), StratifiedSampler(9)
    rays = rays_towards_origin(5)
    rendering = Renderer(field, sampler, ConstantBackground("white")).eval()(rays)
    edges = torch.linspace(1, 5, 10)
    for r in range(5):
        points = rays.origins[r] + 0.5 * (edges[1:] + edges[:-1])[:, None] * rays.directions[r]
        output = field(points, rays.directions[r].expand(9, 3), rays.times[r].expand(9))
        edge_list = edges.tolist()
        pixel = composite_ray(edge_list[:-1], edge_list[1:], output.density.tolist(), output.rgb.tolist(), (1, 1, 1))
        # Positions differ by a float32 rounding of size 5e-7, which the encoding's fastest octave multiplies by 4.
        assert rendering.rgb[r].tolist() == pytest.approx(pixel.rgb, abs=1e-5)
        assert rendering.depth[r].item() == pytest.approx(pixel.depth, rel=1e-5)


@both_samplers
@pytest.mark.parametrize("chunk", [1, 10, 34, 35, 1000])
def test_image_equals_its_rays_for_any_chunk(sampler: str, chunk: int) -> None:
    renderer = Renderer(trained_field(), SAMPLERS[sampler]())
    camera = some_camera()
    image = renderer.render_image(camera, 0.3, chunk=chunk)
    rays = renderer.eval()(camera.rays(0.3))
    assert image.rgb.shape == (5, 7, 3)
    assert image.opacity.shape == image.depth.shape == (5, 7)
    # Matrix products of other sizes round differently.
    torch.testing.assert_close(image.rgb.flatten(0, 1), rays.rgb, rtol=0, atol=1e-5)
    torch.testing.assert_close(image.opacity.flatten(), rays.opacity, rtol=0, atol=1e-5)
    torch.testing.assert_close(image.depth.flatten(), rays.depth, rtol=0, atol=1e-4)
    assert image.weights is None
    assert image.samples is None


def test_time_moves_the_picture() -> None:
    renderer = Renderer(trained_field(), StratifiedSampler(16))
    first, last = renderer.render_image(some_camera(), 0.0), renderer.render_image(some_camera(), 1.0)
    assert (first.rgb - last.rgb).abs().max() > 0.01


@pytest.mark.parametrize("time", [-0.01, 1.01, math.nan, math.inf])
def test_times_outside_the_film_are_refused(time: float) -> None:
    with pytest.raises(ValueError, match=rf"time must be in \[0, 1\], got {time}"):
        Renderer(fog(), StratifiedSampler(4)).render_image(some_camera(), time)


@pytest.mark.parametrize("chunk", [0, -5])
def test_chunks_must_be_positive(chunk: int) -> None:
    with pytest.raises(ValueError, match="chunk must be > 0"):
        Renderer(fog(), StratifiedSampler(4)).render_image(some_camera(), 0.5, chunk=chunk)


def test_background_is_white_unless_said_otherwise() -> None:
    assert torch.equal(
        Renderer(fog(0.0), StratifiedSampler(4)).render_image(some_camera(), 0.0).rgb, torch.ones(5, 7, 3)
    )


def test_random_backgrounds_only_in_training() -> None:
    renderer = Renderer(fog(0.0), StratifiedSampler(4), RandomBackground("black"))
    rays = rays_towards_origin(50)
    colors = renderer.train()(rays, generator=seeded(0))
    assert len(colors.rgb.unique(dim=0)) == 50
    assert torch.equal(colors.rgb, colors.background)
    assert torch.count_nonzero(renderer.eval()(rays, generator=seeded(0)).rgb) == 0
    renderer.train()
    assert torch.count_nonzero(renderer.render_image(some_camera(), 0.0).rgb) == 0


def test_training_follows_its_generator() -> None:
    renderer = Renderer(trained_field(), StratifiedSampler(8), RandomBackground()).train()
    rays = rays_towards_origin(20)
    first, again, other = (renderer(rays, generator=seeded(seed)).rgb for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_coarse_pictures_come_with_the_fine_one_on_the_same_background() -> None:
    renderer = Renderer(fog(0.5), ImportanceSampler(8, 8, fog(0.0)), RandomBackground()).train()
    rendering = renderer(rays_towards_origin(10), generator=seeded(0))
    (coarse,) = rendering.proposals
    assert torch.equal(coarse.rgb, rendering.background)
    assert coarse.weights is not None
    assert coarse.weights.shape == (10, 8)


@both_samplers
def test_bfloat16_is_near_float32(sampler: str) -> None:
    field = trained_field()
    exact, half = (
        Renderer(field, SAMPLERS[sampler](), precision=precision).eval()(rays_towards_origin(100))
        for precision in ("float32", "bfloat16")
    )
    assert half.rgb.dtype == half.opacity.dtype == half.depth.dtype == torch.float32
    # Networks lose digits of 2^-8; positions and compositing must not.
    torch.testing.assert_close(half.rgb, exact.rgb, rtol=0, atol=0.03)
    torch.testing.assert_close(half.opacity, exact.opacity, rtol=0, atol=0.03)
    assert not torch.equal(half.rgb, exact.rgb)
    if sampler == "stratified":
        assert half.samples is not None
        assert exact.samples is not None
        assert torch.equal(half.samples.starts, exact.samples.starts)


def test_bfloat16_leaves_fields_without_networks_exact() -> None:
    rays = rays_towards_origin(20)
    exact, half = (
        Renderer(soft_ball(), ImportanceSampler(8, 8), precision=precision).eval()(rays)
        for precision in ("float32", "bfloat16")
    )
    for name in ("rgb", "opacity", "depth", "weights"):
        assert torch.equal(getattr(exact, name), getattr(half, name))


def test_float32_means_float32_under_an_outer_autocast() -> None:
    renderer, rays = Renderer(trained_field(), StratifiedSampler(8)).eval(), rays_towards_origin(20)
    exact = renderer(rays).rgb
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(renderer(rays).rgb, exact)


def test_gradients_reach_every_parameter_in_bfloat16() -> None:
    renderer = Renderer(trained_field(), ImportanceSampler(8, 8, trained_field()), precision="bfloat16").train()
    rendering: Rendering = renderer(rays_towards_origin(50))
    (rendering.rgb.sum() + sum(proposal.rgb.sum() for proposal in rendering.proposals)).backward()
    for parameter in renderer.parameters():
        assert parameter.grad is not None
        assert torch.isfinite(parameter.grad).all()
        assert torch.count_nonzero(parameter.grad) > 0


def test_unknown_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="precision must be one of float32, bfloat16; got 'float16'"):
        Renderer(fog(), StratifiedSampler(4), precision="float16")


def test_images_leave_every_modules_mode_as_it_was() -> None:
    renderer = Renderer(trained_field(), StratifiedSampler(4)).train()
    renderer.field.eval()
    before = [module.training for module in renderer.modules()]
    renderer.render_image(some_camera(), 0.5)
    assert [module.training for module in renderer.modules()] == before
    with pytest.raises(RuntimeError, match="broken"):
        Renderer.render_image(broken := Renderer(fog(), Broken(4)).train(), some_camera(), 0.5)
    assert broken.training
    assert broken.sampler.training


class Broken(StratifiedSampler):
    """Fails when asked."""

    def forward(self, *args: object, **kwargs: object) -> None:
        raise RuntimeError("broken")


def test_images_carry_no_gradient() -> None:
    image = Renderer(trained_field(), StratifiedSampler(4)).render_image(some_camera(), 0.5)
    assert not image.rgb.requires_grad


def test_progress_reaches_every_window() -> None:
    field = DeformedField(DisplacementDeformation(1, 8, (), window_end=0.5), NeRFField(1, 8, ()))
    renderer = Renderer(
        field,
        ImportanceSampler(4, 4, DeformedField(DisplacementDeformation(1, 8, (), window_end=1.0), NeRFField(1, 8, ()))),
    )
    renderer.set_progress(0.5)
    windows = [buffer for name, buffer in renderer.named_buffers() if name.endswith("encode_positions.window")]
    opened = sorted(window.mean().item() for window in windows if window.numel() == 10)
    assert opened == pytest.approx([0.5, 1.0, 1.0, 1.0], abs=1e-6)


@both_samplers
def test_all_empty_rays_show_the_background(sampler: str) -> None:
    rays = rays_towards_origin(6)
    empty = type(rays)(rays.origins, rays.directions, rays.times, rays.far, rays.near)
    renderer = Renderer(trained_field(), SAMPLERS[sampler](), ConstantBackground([0.25, 0.5, 0.75]))
    assert torch.equal(renderer(empty).rgb, torch.tensor([0.25, 0.5, 0.75]).expand(6, 3))


def test_renderer_without_rays_gives_no_pixels() -> None:
    renderer: nn.Module = Renderer(trained_field(), ImportanceSampler(4, 4))
    assert renderer(rays_towards_origin(3)[:0]).rgb.shape == (0, 3)


class CountingFog(RadianceField):
    """A ball of fog that remembers at how many points it was asked, in all and at once of late."""

    def __init__(self, density: float) -> None:
        super().__init__()
        self.strength = density
        self.num_points = self.most_at_once = 0

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.strength * (positions.norm(dim=-1) < 0.9).to(positions.dtype)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        self.num_points += len(times)
        self.most_at_once = len(times)
        return FieldOutput(self.density(positions, times), torch.sigmoid(4 * positions))


BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


@pytest.mark.parametrize("density", [0.0, 0.5, 3.0, 100.0])
@pytest.mark.parametrize("stop", [1e-4, 1e-2, 0.3])
def test_rays_that_end_early_change_colours_by_no_more_than_the_light_left(density: float, stop: float) -> None:
    field = CountingFog(density)
    whole = Renderer(field, OccupancySampler(BOX, 0.02))
    early = Renderer(field, OccupancySampler(BOX, 0.02), stop_transmittance=stop)
    camera = some_camera(63, 51)
    exact = whole.render_image(camera, 0.5)
    asked, field.num_points = field.num_points, 0
    image = early.render_image(camera, 0.5)
    assert (image.rgb - exact.rgb).abs().max() <= stop + 1e-6
    assert (image.opacity - exact.opacity).abs().max() <= stop + 1e-6
    # Light left over is at most `stop`, and is absorbed within the box, 2 sqrt(3) across.
    assert ((image.depth - exact.depth) * exact.opacity).abs().max() <= stop * 2 * math.sqrt(3) + 1e-5
    if density == 100.0:
        # Rays through the corners of the box meet no ball and never end.
        assert field.num_points < 0.65 * asked


def test_images_with_and_without_early_ends_agree_where_nothing_is_opaque() -> None:
    """Rounds are put together without loss: only rounding differs."""
    field = CountingFog(0.5)
    whole = Renderer(field, OccupancySampler(BOX, 0.02)).render_image(some_camera(21, 17), 0.5)
    rounds = Renderer(field, OccupancySampler(BOX, 0.02), stop_transmittance=1e-6).render_image(
        some_camera(21, 17), 0.5
    )
    for name in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(getattr(rounds, name), getattr(whole, name), rtol=0, atol=2e-6)


def test_samplers_that_place_all_samples_at_once_end_early_too() -> None:
    class AllAtOnce(OccupancySampler):
        def first(self, rays: Rays, most: int) -> Samples | None:
            return None

    field, camera = CountingFog(100.0), some_camera(21, 17)
    pictures = [
        Renderer(field, sampler, stop_transmittance=1e-2).render_image(camera, 0.5)
        for sampler in (OccupancySampler(BOX, 0.02), AllAtOnce(BOX, 0.02))
    ]
    torch.testing.assert_close(pictures[0].rgb, pictures[1].rgb, rtol=0, atol=2e-6)


def test_samplers_that_place_all_samples_at_once_split_them_once() -> None:
    class AllAtOnce(OccupancySampler):
        def first(self, rays: Rays, most: int) -> Samples | None:
            return None

    counts, pictures = [], []
    for make, step, splits in ((OccupancySampler, 0.02, 1), (AllAtOnce, 0.06, 3)):
        field = CountingFog(1.0)
        sampler = make(BOX, step, splits=splits)
        pictures.append(Renderer(field, sampler, stop_transmittance=1e-6).render_image(some_camera(21, 17), 0.5))
        counts.append(field.num_points)
    assert counts[1] == pytest.approx(counts[0], rel=0.2)
    torch.testing.assert_close(pictures[0].opacity, pictures[1].opacity, rtol=0, atol=1e-5)


@pytest.mark.parametrize("fixed", [False, True])
def test_padding_is_not_observed_in_training(fixed: bool) -> None:
    """Fog that is only at the cameras, beyond the box, where empty places of a fixed number of them lie."""

    class Beyond(RadianceField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return 50.0 * (positions.abs().amax(-1) > 1.5).to(positions.dtype)

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return FieldOutput(self.density(positions, times), torch.sigmoid(positions))

    sampler = OccupancySampler(BOX, 0.1, 16, pad_to=512)
    before = sampler.maxima.clone()
    if fixed:
        sampler.fix_sizes(4096, 2048)
    renderer = Renderer(Beyond(), sampler).train()
    rendering = renderer(some_camera(5, 5).rays(0.5), generator=torch.Generator().manual_seed(0))
    assert rendering.samples is not None
    assert (rendering.samples.lengths == 0).any()
    assert torch.equal(sampler.maxima <= 0.01, torch.ones_like(before, dtype=torch.bool))


def test_what_is_no_number_shows_in_training_too() -> None:
    """A filter that left it out would hide what is wrong, and the occupancy grid forget where matter is."""

    class Broken(RadianceField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return torch.where(positions[..., 0] > 0.3, math.nan, 5.0)

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return FieldOutput(self.density(positions, times), torch.sigmoid(positions))

    for fixed in (False, True):
        sampler = OccupancySampler(BOX, 0.1, 16, min_weight=0.01)
        if fixed:
            sampler.fix_sizes(1 << 14, 1 << 14)
        rendering = Renderer(Broken(), sampler).train()(some_camera(9, 9).rays(0.5))
        assert rendering.rgb.isnan().any()
        assert rendering.rgb.isfinite().any() or fixed  # whose empty places lie at the camera, where it is none either


def test_the_field_is_asked_in_parts_where_there_is_much_to_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    field, sampler = CountingFog(0.5), OccupancySampler(BOX, 0.06, splits=3)
    pictures = []
    for most in (1 << 18, 1000):
        monkeypatch.setattr("dnerf.fields.base.MOST_AT_ONCE", most)
        pictures.append(Renderer(field, sampler, stop_transmittance=1e-6).render_image(some_camera(21, 17), 0.5))
    assert torch.equal(pictures[0].rgb, pictures[1].rgb)
    assert field.most_at_once <= 1000


@pytest.mark.parametrize("stop", [-0.1, 1.0, math.nan])
def test_a_stop_outside_its_range_is_refused(stop: float) -> None:
    with pytest.raises(ValueError, match=r"stop_transmittance must be in \[0, 1\)"):
        Renderer(fog(), StratifiedSampler(4), stop_transmittance=stop)


def test_quadrature_is_that_of_the_compositor() -> None:
    rays = rays_towards_origin(50)
    pictures = {}
    for rule in ("constant", "linear", "parabolic"):
        renderer = Renderer(soft_ball(), StratifiedSampler(12), quadrature=rule).eval()
        samples = renderer.sampler(rays, renderer.field)
        pictures[rule] = renderer(rays).rgb
        expected = composite(samples, renderer.field(*samples.locate(rays)), torch.ones(3), quadrature=rule).rgb
        assert torch.equal(pictures[rule], expected)
    assert (pictures["constant"] - pictures["parabolic"]).abs().max() > 1e-4
    with pytest.raises(ValueError, match="quadrature must be one of"):
        Renderer(soft_ball(), StratifiedSampler(12), quadrature="cubic")


@pytest.mark.parametrize("background", [ConstantBackground("white"), RandomBackground("black"), Sky()])
@pytest.mark.parametrize("share", [0.0, 0.02])
def test_a_picture_of_pixels_that_may_see_something_is_that_of_all(background: nn.Module, share: float) -> None:
    sampler = OccupancySampler([[-1.0] * 3, [1.0] * 3], 0.05, 16, num_slabs=4, pad_to=1)
    sampler.occupy(torch.rand(sampler.occupied.shape, generator=seeded(0)) < share)
    renderer = Renderer(trained_field(), sampler, background, stop_transmittance=1e-3)
    camera = some_camera(40, 30)
    quick = renderer.render_image(camera, 0.6, chunk=100)
    assert len(sampler.seen_rays(camera, 0.6)[0]) < 40 * 30
    sampler.seen_rays = lambda camera, time: None
    whole = renderer.render_image(camera, 0.6, chunk=100)
    for name in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(
            getattr(quick, name), getattr(whole, name), rtol=0, atol=1e-5
        )  # distances, from where rays are cut short
    assert bool(whole.opacity.any()) == bool(share)
