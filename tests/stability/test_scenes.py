"""Hard scenes: what samples without knowledge see of them, in float32 against float64, and closed forms."""

import math

import pytest
import torch
from reference import occupancy_sampler

from dnerf.core.compositing import composite
from dnerf.core.rays import Rays
from dnerf.data import render_exact
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import AnalyticScene, Ball, Body, Box, Fixed, Plain, make_scene

HARD = [
    "thin_rod", "opaque_wall", "merging_balls", "vanishing_ball", "jumping_ball", "twisting_block",
    "bending_rod", "dense_fog", "bouncing_balls", "snowman",
]  # fmt: skip


def camera_rays(count: int, seed: int = 0) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    origins = 4 * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    targets = 1.6 * torch.rand(count, 3, generator=generator) - 0.8
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    near = torch.full((count,), 2.0)
    return Rays(origins, directions, torch.rand(count, generator=generator), near, near + 4)


@pytest.mark.parametrize("name", HARD)
def test_images_without_knowledge_are_finite_and_alike_in_float32_and_float64(name: str) -> None:
    scene, rays = make_scene(name), camera_rays(600)
    sampler = StratifiedSampler(128, scene.box).eval()
    rounded, exact = (
        composite(s, scene(*s.locate(r)), torch.ones(3)).rgb
        for r, s in ((r, sampler(r, scene)) for r in (rays, rays.to(torch.float64)))
    )
    assert torch.isfinite(rounded).all()
    error = (rounded.double() - exact).abs().amax(-1)
    # A sample within rounding of a surface may be on either side of it: rare, and then worth one interval.
    assert error.quantile(0.97) < 1e-5


@pytest.mark.parametrize("name", HARD)
def test_occupancy_loses_none_of_a_scene(name: str) -> None:
    scene, rays = make_scene(name), camera_rays(400, 1)
    box = (1.3 * scene.box).tolist()
    sampler = occupancy_sampler(box, 0.02, 32, num_slabs=16, threshold=0.01, pad_to=1).eval()
    everywhere = Renderer(scene, sampler).eval()
    full = everywhere(rays).rgb
    sampler.grid.fill(scene, 4)
    assert (~sampler.grid.occupied).any()
    guided = everywhere(rays).rgb
    if name == "thin_rod":
        # Random probes cannot find a rod that fills 1e-4 of a cell: only the hub is certain to stay.
        return
    assert (guided - full).abs().amax(-1).quantile(0.995) < 1e-6


def test_a_rod_a_thousandth_thick_is_missed_by_samples_and_seen_by_edges() -> None:
    scene = make_scene("thin_rod")
    rod = scene.bodies[0]
    time = torch.tensor([0.1], dtype=torch.float64)
    pose = rod.motion.pose(time)
    middle = pose.to_world(torch.tensor([[1.6, 0.0, 0.0]], dtype=torch.float64))
    across = torch.linalg.cross(pose.rotation[:, :, 0], torch.tensor([[0.3, 0.5, 0.7]], dtype=torch.float64))
    direction = torch.nn.functional.normalize(across, dim=-1)
    one = torch.ones(1, dtype=torch.float64)
    rays = Rays(middle - 2 * direction, direction, time, 0 * one, 4 * one)
    chord = 2 * rod.shape.radius
    _, opacity, _ = render_exact(scene, rays)
    assert opacity.item() == pytest.approx(-math.expm1(-rod.density * chord), rel=1e-9)
    samples = StratifiedSampler(500).eval()(rays, scene)
    assert samples.lengths[0, 0] > 3 * chord


def test_a_camera_in_front_of_a_wall_and_one_inside_it_see_its_colour_alone() -> None:
    scene = make_scene("opaque_wall")
    for x in (0.95, 0.9):
        rays = Rays(
            torch.tensor([[x, 0.1, 0.1]]), torch.tensor([[-1.0, 0.0, 0.0]]),
            torch.zeros(1), torch.zeros(1), torch.ones(1),
        )  # fmt: skip
        rgb, opacity, depth = render_exact(scene, rays)
        assert opacity.item() == 1
        torch.testing.assert_close(rgb[0], torch.tensor(scene.bodies[0].texture.rgb))
        assert depth.item() < max(0.0, x - 0.94) + 1e-4


@pytest.mark.parametrize("length", [1.0, 100.0, 10000.0])
@pytest.mark.parametrize("total", [1e-6, 1.0, 50.0, 1e5])
def test_fog_over_a_long_ray_has_its_closed_form_with_4096_samples(length: float, total: float) -> None:
    half = 0.5 * length
    body = Body(Box((half, 1.0, 1.0)), Plain((0.25, 0.5, 0.75)), Fixed((half, 0.0, 0.0)), total / length)
    scene = AnalyticScene([body], ((0.0, -1.0, -1.0), (length, 1.0, 1.0)))
    one = torch.ones(1)
    rays = Rays(torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]), 0 * one, 0 * one, length * one)
    samples = StratifiedSampler(4096).eval()(rays, scene)
    rendering = composite(samples, scene(*samples.locate(rays)))
    # Interval lengths are differences of distances rounded to 6e-8 of the ray: they add up to it all the same.
    assert rendering.opacity.item() == pytest.approx(-math.expm1(-total), rel=2e-6)
    assert rendering.rgb[0, 0].item() == pytest.approx(-0.25 * math.expm1(-total), rel=2e-6)


def test_merging_bodies_add_up_where_they_overlap() -> None:
    scene = make_scene("merging_balls")
    time = torch.tensor([0.5], dtype=torch.float64)
    ray = Rays(
        torch.tensor([[0.0, -2.0, 0.0]], dtype=torch.float64), torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64),
        time, 0 * time, 0 * time + 4,
    )  # fmt: skip
    radius, density = scene.bodies[0].shape.radius, scene.bodies[0].density
    assert isinstance(scene.bodies[0].shape, Ball)
    _, opacity, _ = render_exact(scene, ray)
    assert opacity.item() == pytest.approx(-math.expm1(-2 * density * 2 * radius), rel=1e-12)
