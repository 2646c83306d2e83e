"""What every analytic scene must do; a new scene is covered as soon as it is registered."""

from dataclasses import replace

import pytest
import torch
from brute_force import render_ray
from torch import Tensor
from torch.nn.functional import normalize

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.compositing import Rendering, composite
from dnerf.core.rays import Rays, Samples
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import Sampler
from dnerf.scenes import SCENES, AnalyticScene, make_scene

VIEW_DEPENDENT = {"glossy_ball"}
STILL = {"static"}


def random_rays(count: int) -> Rays:
    """Rays of a camera on the sphere of radius 4 towards places in the scene, each at its own time."""
    origins = 4 * normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)
    targets = 1.6 * torch.rand(count, 3, dtype=torch.float64) - 0.8
    near = torch.full((count,), 2.0, dtype=torch.float64)
    return Rays(origins, normalize(targets - origins, dim=-1), torch.rand(count).double(), near, near + 4.5)


def rays_within(count: int) -> Rays:
    """Rays that begin inside the scene, half of them along an axis."""
    rays = random_rays(count)
    directions = rays.directions.clone()
    axis = torch.arange(0, count, 2)
    directions[axis] = torch.eye(3, dtype=torch.float64)[axis % 3] * (1 - 2.0 * (axis[:, None] % 4 == 0))
    return replace(rays, origins=0.3 * rays.origins / 4, directions=directions, near=0 * rays.near)


def render(scene: AnalyticScene, rays: Rays, background: float = 1.0) -> Rendering:
    samples = scene.exact_samples(rays)
    return composite(samples, scene(*samples.locate(rays)), torch.full((3,), background, dtype=rays.origins.dtype))


def material_points(scene: AnalyticScene, count: int, *times: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points in one body only at two times, random unless given: local positions, body indices, times t0 and t1."""
    shapes = [body.shape for body in scene.bodies]
    boxes = [torch.tensor(shape.bounds, dtype=torch.float64) for shape in shapes]
    local = [torch.lerp(*box, torch.rand(count, 3, dtype=torch.float64)) for box in boxes]
    local = [(1 - 1e-6) * points[shape.contains(points)] for shape, points in zip(shapes, local)]
    owners = torch.arange(len(shapes)).repeat_interleave(torch.tensor([len(points) for points in local]))
    points = torch.cat(local)
    t0, t1 = 1e-3 + 0.998 * torch.rand(2, len(points), dtype=torch.float64)
    if times:
        t0, t1 = (torch.full_like(t0, time) for time in times)
    first, second = (scene.contains(to_world(scene, points, owners, t), t).sum(-1) == 1 for t in (t0, t1))
    kept = first & second
    assert kept.sum() > count / 4
    return points[kept], owners[kept], t0[kept], t1[kept]


def to_world(scene: AnalyticScene, local: Tensor, owners: Tensor, times: Tensor) -> Tensor:
    moved = torch.stack([body.motion.pose(times).to_world(local) for body in scene.bodies])
    return moved[owners, torch.arange(len(owners))]


@pytest.mark.parametrize("make_rays", [random_rays, rays_within])
def test_images_agree_with_brute_force(scene: AnalyticScene, make_rays) -> None:
    rays = make_rays(6)
    rendering = render(scene, rays)
    assert (rendering.opacity > 0).any()
    for i in range(len(rays)):
        color, opacity, depth = render_ray(scene, rays[i : i + 1], 1.0)
        assert (rendering.rgb[i] - color).abs().max() < 1e-12
        assert abs(rendering.opacity[i].item() - opacity) < 1e-12
        assert abs(rendering.depth[i].item() - depth) < 1e-11  # divided by the opacity


def test_samples_are_ordered_and_lie_inside_bodies(scene: AnalyticScene) -> None:
    rays = random_rays(500)
    samples = scene.exact_samples(rays)
    assert samples.is_packed
    assert ((samples.starts <= samples.distances) & (samples.distances <= samples.ends)).all()
    same_ray = samples.ray_indices.diff() == 0
    assert (samples.ray_indices.diff() >= 0).all()
    assert (samples.starts[1:] >= samples.ends[:-1])[same_ray].all()
    assert (samples.starts >= samples.per_sample(rays.near)).all()
    assert (samples.ends <= samples.per_sample(rays.far)).all()
    assert (scene.density(samples.locate(rays)[0], samples.per_sample(rays.times)) > 0).all()


def test_density_and_forward_agree_and_colors_are_in_range(scene: AnalyticScene) -> None:
    positions = torch.lerp(*scene.box.double(), torch.rand(4000, 3).double())
    times = torch.rand(4000, dtype=torch.float64)
    directions = normalize(torch.randn(4000, 3, dtype=torch.float64), dim=-1)
    output = scene(positions, directions, times)
    assert torch.equal(output.density, scene.density(positions, times))
    assert torch.equal(output.density > 0, scene.body_indices(positions, times) >= 0)
    assert 0 < (output.density > 0).double().mean() < 1
    assert ((output.rgb >= 0) & (output.rgb <= 1)).all()
    grid = scene(positions.reshape(40, 100, 3), directions.reshape(40, 100, 3), times.reshape(40, 100))
    assert torch.equal(grid.rgb.reshape(-1, 3), output.rgb)
    assert torch.equal(scene.density(positions[0], times[0]), output.density[0])


def test_bodies_stay_inside_the_box(scene: AnalyticScene) -> None:
    times = torch.rand(3000, dtype=torch.float64)
    for body in scene.bodies:
        center = torch.tensor(body.shape.bounds, dtype=torch.float64).mean(0).expand(3000, 3)
        directions = normalize(torch.randn(3000, 3, dtype=torch.float64), dim=-1)
        _, leave = body.shape.intersect(center, directions)
        surface = body.motion.pose(times).to_world(center + leave[:, None] * directions)
        assert ((surface > scene.box[0]) & (surface < scene.box[1])).all()


def test_the_canonical_camera_sees_the_whole_box_between_near_and_far(scene: AnalyticScene) -> None:
    distance = torch.cartesian_prod(*scene.box.T).norm(dim=-1)
    assert (distance < 2).all()  # z-depths between 2 and 6 from any camera at distance 4


def test_each_ray_has_its_own_time(scene: AnalyticScene) -> None:
    rays = random_rays(12)
    together = render(scene, rays).rgb
    alone = torch.cat([render(scene, rays[i : i + 1]).rgb for i in range(len(rays))])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-13)


def test_material_points_stay_in_their_body_and_keep_their_color(scene: AnalyticScene) -> None:
    local, owners, t0, t1 = material_points(scene, 400)
    start = to_world(scene, local, owners, t0)
    end = scene.advect(start, t0, t1)
    assert torch.equal(scene.body_indices(start, t0), owners)
    assert torch.equal(scene.body_indices(end, t1), owners)
    assert torch.equal(scene.advect(start, t0, t1, owners), end)
    torch.testing.assert_close(end, to_world(scene, local, owners, t1), rtol=0, atol=1e-14)
    torch.testing.assert_close(scene.advect(end, t1, t0), start, rtol=0, atol=1e-14)
    view = normalize(torch.randn(1, 3, dtype=torch.float64), dim=-1).expand_as(start)
    torch.testing.assert_close(scene(start, view, t0).rgb, scene(end, view, t1).rgb, rtol=0, atol=1e-12)


def test_advection_composes_takes_numbers_and_leaves_empty_space_alone(scene: AnalyticScene) -> None:
    local, owners, t0, _ = material_points(scene, 100, 0.0, 0.3)
    start = to_world(scene, local, owners, t0)
    direct = scene.advect(start, 0.0, 0.9)
    torch.testing.assert_close(scene.advect(scene.advect(start, 0.0, 0.3), 0.3, 0.9), direct, rtol=0, atol=1e-14)
    assert torch.equal(scene.advect(start.reshape(1, -1, 3), 0.0, 0.9)[0], direct)
    outside = 3 + torch.rand(5, 3)
    assert torch.equal(scene.advect(outside, 0.2, 0.7), outside)
    assert (scene.body_indices(outside, torch.rand(5)) == -1).all()


def test_advection_follows_the_velocity_of_the_motion(scene: AnalyticScene) -> None:
    local, owners, times, _ = material_points(scene, 100)
    moving = times.clone().requires_grad_()
    places = to_world(scene, local, owners, moving) + 0 * moving[:, None]  # what stands still has a gradient too
    velocity = [torch.autograd.grad(places[:, i].sum(), moving, retain_graph=True)[0] for i in range(3)]
    step, start = 1e-5, places.detach()
    difference = scene.advect(start, times, times + step) - scene.advect(start, times, times - step)
    # second order: step^2 / 6 times third derivatives of up to (4 pi)^3, and rounding / step
    torch.testing.assert_close(difference / (2 * step), torch.stack(velocity, -1), rtol=0, atol=1e-7)


def test_films_loop_and_only_still_scenes_stand_still(scene: AnalyticScene, name: str) -> None:
    rays = random_rays(300)
    start, later, end = (render(scene, replace(rays, times=0 * rays.times + t)).rgb for t in (0.0, 0.3, 1.0))
    torch.testing.assert_close(start, end, rtol=0, atol=1e-7)  # grazing rays magnify rounding
    assert torch.equal(start, later) == (name in STILL)


def test_only_glossy_scenes_depend_on_the_direction(scene: AnalyticScene, name: str) -> None:
    positions, times = 0.8 * normalize(torch.randn(3000, 3), dim=-1) * torch.rand(3000, 1), torch.rand(3000)
    first, second = (scene(positions, normalize(torch.randn(3000, 3), dim=-1), times).rgb for _ in range(2))
    assert torch.equal(first, second) == (name not in VIEW_DEPENDENT)


def test_float32_agrees_with_float64(scene: AnalyticScene) -> None:
    rays = random_rays(1000)
    exact, rounded = render(scene, rays).rgb, render(scene, rays.to(torch.float32)).rgb
    assert rounded.dtype == torch.float32
    error = (exact - rounded).abs().amax(-1)
    # Distances near 4 are rounded to 2e-7, which a density of 80 turns into 2e-5 of opacity; grazing rays and edges
    # of checkers magnify it.
    assert error.quantile(0.98) < 3e-5
    assert error.max() < 5e-2


def test_rays_that_miss_or_are_empty_show_the_background(scene: AnalyticScene) -> None:
    rays = random_rays(4)
    inwards = replace(rays, directions=-normalize(rays.origins, dim=-1))
    missing = replace(rays, directions=-inwards.directions)
    backwards, no_length = replace(inwards, near=rays.far, far=rays.near), replace(inwards, near=rays.far)
    for empty in (missing, backwards, no_length):
        rendering = render(scene, empty, background=0.25)
        assert (rendering.rgb == 0.25).all()
        assert (rendering.opacity == 0).all()
    nothing = torch.zeros(0, 3)
    for empty in (render(scene, rays[:0]).rgb, scene(nothing, nothing, nothing[:, 0]).rgb, scene.advect(nothing, 0, 1)):
        assert empty.shape == (0, 3)


class ExactSampler(Sampler):
    """The scene's own samples."""

    def forward(self, rays: Rays, field, *, generator: torch.Generator | None = None) -> Samples:
        return field.exact_samples(rays)


def test_scene_renders_through_the_shared_renderer_in_any_precision(scene: AnalyticScene) -> None:
    assert not list(scene.parameters())
    assert not scene.state_dict()
    camera = Camera(Intrinsics.from_angle(24, 24, 0.6911), look_at((3.2, 1.6, 1.8)))
    image = Renderer(scene, ExactSampler()).render_image(camera, 0.3)
    assert image.rgb.shape == (24, 24, 3)
    assert (image.opacity > 0.5).any()
    assert (image.opacity == 0).any()
    # No network runs in half precision here, so autocast must change nothing.
    autocast = Renderer(scene, ExactSampler(), precision="bfloat16").render_image(camera, 0.3)
    assert torch.equal(image.rgb, autocast.rgb)


def test_unknown_scene_and_bad_options_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"scene must be one of .*walker; got 'runner'"):
        make_scene("runner")
    with pytest.raises(ValueError, match="circle_radius must be in"):
        SCENES["walker"](circle_radius=1.0)
    with pytest.raises(ValueError, match="cycles must be > 0"):
        SCENES["walker"](cycles=0)
    with pytest.raises(ValueError, match="amplitude must be in"):
        SCENES["pulsing_fog"](amplitude=0.9)


def test_scenes_with_other_options_stay_in_their_box() -> None:
    test_bodies_stay_inside_the_box(SCENES["walker"](cycles=4, circle_radius=0.35))
    test_bodies_stay_inside_the_box(SCENES["pulsing_fog"](amplitude=0.3))
