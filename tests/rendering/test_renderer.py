"""The renderer: the same pixel whatever the chunk, the batch and the precision."""

import math

import pytest
import torch
from reference import fog, occupancy_sampler, rays_towards_origin, soft_ball
from torch import Tensor, nn

from dnerf.core.backgrounds import Background, ConstantBackground, RandomBackground
from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import FieldOutput, Rendering, composite
from dnerf.core.rays import Rays, Samples
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, NeRFField, RadianceField
from dnerf.kernels import has_bfloat16
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Capacity, ImportanceSampler, Sampler, StratifiedSampler


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def trained_field() -> RadianceField:
    """A small dynamic field, dense and coloured, as training would leave it."""
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

    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
        return 0.5 + 0.5 * rays.directions


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
    assert torch.equal(colors.rgb, torch.full((50, 3), 0.5))
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


def test_coarse_images_come_with_the_fine_one_on_the_same_background() -> None:
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
    assert torch.equal(half.rgb, exact.rgb) != has_bfloat16("cpu")  # else it runs in float32
    if sampler == "stratified":
        assert half.samples is not None
        assert exact.samples is not None
        assert torch.equal(half.samples.starts, exact.samples.starts)


def test_without_instructions_for_bfloat16_networks_run_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dnerf.rendering.renderer.has_bfloat16", lambda device: False)
    field, rays = trained_field(), rays_towards_origin(20)
    exact, half = (Renderer(field, StratifiedSampler(8), precision=p).eval()(rays) for p in ("float32", "bfloat16"))
    assert torch.equal(half.rgb, exact.rgb)


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
    """Fails."""

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


class CountingFog(RadianceField):
    """A ball of fog that remembers at how many points it was evaluated, in all and at once of late."""

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
    whole = Renderer(field, occupancy_sampler(BOX, 0.02))
    early = Renderer(field, occupancy_sampler(BOX, 0.02), stop_transmittance=stop)
    camera = some_camera(63, 51)
    exact = whole.render_image(camera, 0.5)
    evaluated, field.num_points = field.num_points, 0
    image = early.render_image(camera, 0.5)
    assert (image.rgb - exact.rgb).abs().max() <= stop + 1e-6
    assert (image.opacity - exact.opacity).abs().max() <= stop + 1e-6
    # Light left over is at most `stop`, and is absorbed within the box, 2 sqrt(3) across.
    assert ((image.depth - exact.depth) * exact.opacity).abs().max() <= stop * 2 * math.sqrt(3) + 1e-5
    if density == 100.0:
        # Rays through the corners of the box meet no ball and never end.
        assert field.num_points < 0.65 * evaluated


def test_images_with_and_without_early_ends_agree_where_nothing_is_opaque() -> None:
    """Rounds are put together without loss: only rounding differs."""
    field = CountingFog(0.5)
    whole = Renderer(field, occupancy_sampler(BOX, 0.02)).render_image(some_camera(21, 17), 0.5)
    rounds = Renderer(field, occupancy_sampler(BOX, 0.02), stop_transmittance=1e-6).render_image(
        some_camera(21, 17), 0.5
    )
    for name in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(getattr(rounds, name), getattr(whole, name), rtol=0, atol=2e-6)


class AllAtOnce(Sampler):
    """Places packed samples of whole rays at once."""

    def __init__(self, inner: Sampler) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        return self.inner(rays, field, generator=generator)


def test_samplers_that_place_all_samples_at_once_end_early_too() -> None:
    field, camera, inner = CountingFog(100.0), some_camera(21, 17), occupancy_sampler(BOX, 0.02)
    images, counts = [], []
    for sampler in (inner, AllAtOnce(inner)):
        field.num_points = 0
        images.append(Renderer(field, sampler, stop_transmittance=1e-2).render_image(camera, 0.5))
        counts.append(field.num_points)
    torch.testing.assert_close(images[0].rgb, images[1].rgb, rtol=0, atol=2e-6)
    assert counts[1] < 1.2 * counts[0]


def test_samplers_that_place_all_samples_at_once_cut_them_once() -> None:
    counts, images = [], []
    for kind, step, subdivision in ((lambda x: x, 0.02, 1), (AllAtOnce, 0.06, 3)):
        field = CountingFog(1.0)
        sampler = kind(occupancy_sampler(BOX, step, subdivision=subdivision))
        images.append(Renderer(field, sampler, stop_transmittance=1e-6).render_image(some_camera(21, 17), 0.5))
        counts.append(field.num_points)
    assert counts[1] == pytest.approx(counts[0], rel=0.2)
    torch.testing.assert_close(images[0].opacity, images[1].opacity, rtol=0, atol=1e-5)


@pytest.mark.parametrize("fixed", [False, True])
def test_padding_is_not_observed_in_training(fixed: bool) -> None:
    """Fog that is only at the cameras, beyond the box, where empty places of a fixed number of them lie."""

    class Beyond(RadianceField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return 50.0 * (positions.abs().amax(-1) > 1.5).to(positions.dtype)

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return FieldOutput(self.density(positions, times), torch.sigmoid(positions))

    sampler = occupancy_sampler(BOX, 0.1, 16, pad_to=512)
    renderer = Renderer(Beyond(), sampler).train()
    capacity = Capacity(4096, 2048) if fixed else None
    rendering = renderer(some_camera(5, 5).rays(0.5), generator=seeded(0), capacity=capacity)
    assert (rendering.samples.lengths == 0).any()
    assert (sampler.grid.maxima <= 0.01).all()


def test_what_is_no_number_shows_in_training_too() -> None:
    """A filter that left it out would hide what is wrong, and the occupancy grid forget where something is."""

    class Broken(RadianceField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            return torch.where(positions[..., 0] > 0.3, math.nan, 5.0)

        def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return FieldOutput(self.density(positions, times), torch.sigmoid(positions))

    for capacity in (None, Capacity(1 << 14, 1 << 14)):
        sampler = occupancy_sampler(BOX, 0.1, 16, min_weight=0.01)
        rendering = Renderer(Broken(), sampler).train()(some_camera(9, 9).rays(0.5), capacity=capacity)
        assert rendering.rgb.isnan().any()
        assert (
            rendering.rgb.isfinite().any() or capacity
        )  # whose empty places lie at the camera, where it is none either


def test_the_field_is_evaluated_in_parts_of_bounded_size(monkeypatch: pytest.MonkeyPatch) -> None:
    field, sampler = CountingFog(0.5), occupancy_sampler(BOX, 0.06, subdivision=3)
    images = []
    for most in (1 << 18, 1000):
        monkeypatch.setattr("dnerf.fields.base.MOST_AT_ONCE", most)
        images.append(Renderer(field, sampler, stop_transmittance=1e-6).render_image(some_camera(21, 17), 0.5))
    assert torch.equal(images[0].rgb, images[1].rgb)
    assert field.most_at_once <= 1000


def test_samples_that_one_places_oneself_are_rendered_alike() -> None:
    renderer, rays = Renderer(trained_field(), StratifiedSampler(8)).eval(), rays_towards_origin(20)
    samples = renderer.sampler(rays, renderer.field)
    rendering = renderer.render_samples(rays, samples, renderer.field)
    assert torch.equal(rendering.rgb, renderer(rays).rgb)
    other = renderer.render_samples(rays, samples, fog(0.0))
    assert torch.equal(other.rgb, torch.ones(20, 3))


def test_a_capacity_is_kept_to_and_what_does_not_fit_shows_the_background() -> None:
    renderer, rays = Renderer(fog(2.0), occupancy_sampler(BOX, 0.1, 8)).eval(), rays_towards_origin(40)
    free, roomy, full = (renderer(rays, capacity=c) for c in (None, Capacity(4096, 2048), Capacity(4096, 100)))
    torch.testing.assert_close(roomy.rgb, free.rgb, rtol=0, atol=1e-6)
    assert roomy.is_placed.all()
    placed = full.is_placed
    assert len(full.samples.starts) == 100
    assert 0 < int(placed.sum()) < 40
    torch.testing.assert_close(full.rgb[placed], free.rgb[placed], rtol=0, atol=1e-6)
    assert (full.rgb[~placed] == 1).all()
    with pytest.raises(ValueError, match="StratifiedSampler cannot place samples in a fixed number of places"):
        Renderer(fog(), StratifiedSampler(4))(rays, capacity=Capacity(64, 64))


@pytest.mark.parametrize("stop", [-0.1, 1.0, math.nan])
def test_a_stop_outside_its_range_is_refused(stop: float) -> None:
    with pytest.raises(ValueError, match=r"stop_transmittance must be in \[0, 1\)"):
        Renderer(fog(), StratifiedSampler(4), stop_transmittance=stop)


def test_quadrature_is_that_of_the_compositor() -> None:
    rays = rays_towards_origin(50)
    images = {}
    for rule in ("constant", "linear", "parabolic"):
        renderer = Renderer(soft_ball(), StratifiedSampler(12), quadrature=rule).eval()
        samples = renderer.sampler(rays, renderer.field)
        images[rule] = renderer(rays).rgb
        expected = composite(samples, renderer.field(*samples.locate(rays)), torch.ones(3), quadrature=rule).rgb
        assert torch.equal(images[rule], expected)
    assert (images["constant"] - images["parabolic"]).abs().max() > 1e-4
    with pytest.raises(ValueError, match="quadrature must be one of"):
        Renderer(soft_ball(), StratifiedSampler(12), quadrature="cubic")


@pytest.mark.parametrize("background", [ConstantBackground("white"), RandomBackground("black"), Sky()])
@pytest.mark.parametrize("share", [0.0, 0.02])
def test_an_image_of_pixels_that_may_show_something_is_that_of_all(background: nn.Module, share: float) -> None:
    sampler = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.05, 16, num_slabs=4, pad_to=1)
    sampler.grid.occupy(torch.rand(sampler.grid.occupied.shape, generator=seeded(0)) < share)
    renderer = Renderer(trained_field(), sampler, background, stop_transmittance=1e-3)
    camera = some_camera(40, 30)
    quick = renderer.render_image(camera, 0.6, chunk=100)
    assert len(sampler.visible_rays(camera, 0.6)[0]) < 40 * 30
    sampler.visible_rays = lambda camera, time: None
    whole = renderer.render_image(camera, 0.6, chunk=100)
    for name in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(
            getattr(quick, name), getattr(whole, name), rtol=0, atol=1e-5
        )  # distances, from where rays are cut short
    assert bool(whole.opacity.any()) == bool(share)
