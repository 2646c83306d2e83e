"""Compositing of exact samples against pictures written down by hand."""

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from dnerf.compositing import Rendering, composite
from dnerf.rays import Rays
from dnerf.scenes import AnalyticScene, Ball, Body, Box, Checker, Fixed, Gradient, Plain, Pulse, Wave, grid_planes

TOLERANCES = {torch.float64: 1e-12, torch.float32: 1e-6}
BOX = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def make_rays(
    origins: list[list[float]],
    directions: list[list[float]],
    *,
    near: float = 0.0,
    far: float = 6.0,
    times: list[float] | None = None,
    dtype: torch.dtype = torch.float64,
) -> Rays:
    count = len(origins)
    direction = torch.tensor(directions, dtype=torch.float64).expand(count, 3)
    return Rays(
        torch.tensor(origins, dtype=torch.float64).reshape(count, 3),
        direction / direction.norm(dim=-1, keepdim=True),
        torch.tensor(times or [0.0] * count, dtype=torch.float64),
        torch.full((count,), near, dtype=torch.float64),
        torch.full((count,), far, dtype=torch.float64),
    ).to(dtype)


def render(scene: AnalyticScene, rays: Rays, background: Tensor | None = None) -> Rendering:
    samples = scene.exact_samples(rays)
    output = scene(samples.positions(rays), samples.per_sample(rays.directions), samples.per_sample(rays.times))
    return composite(samples, output, background)


def absorbed_at(start: float, length: float, density: float) -> float:
    """Expected distance of absorption in one slab, given that it happens."""
    depth = density * length
    if depth < 1e-3:  # the closed form subtracts two numbers of the size of 1 / density
        return start + length * (1 / 2 - depth / 12 + depth**3 / 720)
    return start + 1 / density - length / math.expm1(depth)


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("density", [1e-9, 1e-3, 0.5, 3.0])
@pytest.mark.parametrize("offset", [0.0, 0.3, 0.69])
def test_ball_has_the_opacity_of_its_chord(density: float, offset: float, dtype: torch.dtype) -> None:
    scene = AnalyticScene([Body(Ball(0.7), Plain(RED), density=density)], BOX)
    rays = make_rays([[-1.5, offset, 0.0]], [[1.0, 0.0, 0.0]], dtype=dtype)
    rendering = render(scene, rays, torch.tensor([0.0, 1.0, 1.0], dtype=dtype))
    half = math.sqrt(0.49 - offset**2)
    opacity = -math.expm1(-2 * half * density)
    tolerance = TOLERANCES[dtype]
    assert rendering.opacity.item() == pytest.approx(opacity, abs=tolerance, rel=tolerance)
    assert rendering.rgb[0].tolist() == pytest.approx([opacity, 1 - opacity, 1 - opacity], abs=tolerance)
    # Distances are larger than 1.
    assert rendering.depth.item() == pytest.approx(absorbed_at(1.5 - half, 2 * half, density), abs=3 * tolerance)


@pytest.mark.parametrize("density", [50.0, 1e3, 1e6, 1e9])
def test_opaque_ball_shows_its_surface(density: float) -> None:
    scene = AnalyticScene([Body(Ball(0.7), Gradient(RED, BLUE, (1.0, 0.0, 0.0)), density=density)], BOX)
    rendering = render(scene, make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))
    assert rendering.opacity.item() == pytest.approx(1, abs=1e-14)
    assert rendering.depth.item() == pytest.approx(1.3 + 1 / density, abs=1e-14)
    blue = 0.5 / (0.7 * density)  # mean of a colour linear in depth: that at the mean depth 1 / density
    assert rendering.rgb[0].tolist() == pytest.approx([1 - blue, 0.0, blue], abs=1e-14)


@pytest.mark.parametrize("density", [1e-6, 0.1, 1.0, 4.0, 30.0, 300.0])
def test_linear_color_is_that_at_the_expected_depth(density: float) -> None:
    scene = AnalyticScene([Body(Ball(0.7), Gradient(RED, BLUE, (0.6, 0.0, 0.8)), density=density)], BOX)
    rays = make_rays([[-2.0, 0.1, -0.3]], [[1.0, 0.05, 0.2]])
    rendering = render(scene, rays)
    mean = rays.origins + rendering.depth[:, None] * rays.directions
    share = 0.5 + 0.5 * (0.6 * mean[0, 0] + 0.8 * mean[0, 2]).item() / 0.7
    opacity = rendering.opacity.item()
    assert rendering.rgb[0].tolist() == pytest.approx([opacity * (1 - share), 0, opacity * share], abs=1e-14)


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("swapped", [False, True])
def test_two_slabs_hide_each_other_in_order(swapped: bool, dtype: torch.dtype) -> None:
    first, second = (GREEN, RED) if swapped else (RED, GREEN)
    scene = AnalyticScene(
        [
            Body(Box((0.25, 1.0, 1.0)), Plain(second), Fixed((0.5, 0.0, 0.0)), density=3.0),
            Body(Box((0.5, 1.0, 1.0)), Plain(first), Fixed((-0.5, 0.0, 0.0)), density=0.8),
        ],
        BOX,
    )
    rays = make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], dtype=dtype)
    rendering = render(scene, rays, torch.tensor(BLUE, dtype=dtype))
    near, far = -math.expm1(-0.8), math.exp(-0.8) * -math.expm1(-1.5)
    expected = [near, far, math.exp(-2.3)]
    if swapped:
        expected = [far, near, math.exp(-2.3)]
    assert rendering.rgb[0].tolist() == pytest.approx(expected, abs=TOLERANCES[dtype])
    depth = (near * absorbed_at(1, 1, 0.8) + far * absorbed_at(2.25, 0.5, 3)) / (near + far)
    assert rendering.depth.item() == pytest.approx(depth, abs=3 * TOLERANCES[dtype])


def test_overlapping_bodies_add_up_and_mix() -> None:
    scene = AnalyticScene(
        [
            Body(Box((0.5, 1.0, 1.0)), Plain(RED), Fixed((-0.25, 0.0, 0.0)), density=1.0),
            Body(Box((0.5, 1.0, 1.0)), Plain(BLUE), Fixed((0.25, 0.0, 0.0)), density=3.0),
        ],
        BOX,
    )
    rendering = render(scene, make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))
    first, both, last = (-math.expm1(-tau) for tau in (0.5, 2.0, 1.5))
    both, last = both * math.exp(-0.5), last * math.exp(-2.5)
    assert rendering.rgb[0].tolist() == pytest.approx([first + 0.25 * both, 0, 0.75 * both + last], abs=1e-14)


def test_checkered_slab_shows_its_cells_in_order() -> None:
    board = Checker(Plain(RED), Plain(GREEN), grid_planes(0.2, 2, "x"))
    scene = AnalyticScene([Body(Box((0.5, 1.0, 1.0)), board, density=2.0)], BOX)
    rendering = render(scene, make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))
    cuts = [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0]
    weights = [math.exp(-2 * a) - math.exp(-2 * b) for a, b in pairwise(cuts)]
    assert rendering.rgb[0].tolist() == pytest.approx([sum(weights[::2]), sum(weights[1::2]), 0], abs=1e-14)


def test_rays_are_cut_at_near_and_far() -> None:
    scene = AnalyticScene([Body(Box((0.5, 1.0, 1.0)), Plain(RED), density=2.0)], BOX)
    rays = make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], near=1.7, far=2.1)
    assert render(scene, rays).opacity.item() == pytest.approx(-math.expm1(-0.8), abs=1e-14)


def test_ray_starting_inside_sees_the_rest() -> None:
    scene = AnalyticScene([Body(Ball(0.5), Plain(RED), density=2.0)], BOX)
    rays = make_rays([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0]], [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    expected = [-math.expm1(-0.8), -math.expm1(-1.2)]
    assert render(scene, rays).opacity.tolist() == pytest.approx(expected, abs=1e-14)


def test_fog_that_conserves_mass_gets_thinner_as_it_grows() -> None:
    fog = Body(Ball(0.5), Plain(RED), Pulse(scale=Wave(1.0, ((0.5, 1.0, 0.0),))), 2.0, conserves_mass=True)
    rays = make_rays([[-2.0, 0.0, 0.0]] * 3, [[1.0, 0.0, 0.0]], times=[0.0, 0.25, 0.75])
    expected = [-math.expm1(-2.0 / scale**2) for scale in (1.0, 1.5, 0.5)]
    assert render(AnalyticScene([fog], BOX), rays).opacity.tolist() == pytest.approx(expected, abs=1e-13)
    still = Body(Ball(0.5), Plain(RED), Pulse(scale=Wave(1.0, ((0.5, 1.0, 0.0),))), 2.0)
    expected = [-math.expm1(-2.0 * scale) for scale in (1.0, 1.5, 0.5)]
    assert render(AnalyticScene([still], BOX), rays).opacity.tolist() == pytest.approx(expected, abs=1e-13)


def test_ray_in_a_face_or_touching_a_ball_is_finite() -> None:
    scene = AnalyticScene(
        [Body(Box((0.5, 0.5, 0.5)), Plain(RED)), Body(Ball(0.5), Plain(GREEN), Fixed((0.0, 0.0, 1.0)))], BOX
    )
    rays = make_rays([[-2.0, 0.5, 0.0], [-2.0, 0.5, 0.5], [-2.0, 0.0, 1.5]], [[1.0, 0.0, 0.0]])
    rendering = render(scene, rays)
    for value in (rendering.rgb, rendering.depth, rendering.opacity):
        assert torch.isfinite(value).all()
    assert rendering.opacity[2] == 0  # touches in one point


def test_thin_rod_and_thin_sheet_are_not_missed() -> None:
    scene = AnalyticScene([Body(Box((5e-4, 1.0, 1.0)), Plain(RED), density=100.0)], BOX)
    rendering = render(scene, make_rays([[-2.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))
    # The sheet's edges lie at distances near 2, each rounded to 2e-16.
    assert rendering.opacity.item() == pytest.approx(-math.expm1(-0.1), abs=1e-13)


def test_bad_arguments_are_named() -> None:
    body = Body(Ball(0.5), Plain(RED))
    with pytest.raises(ValueError, match="bodies must hold at least one body"):
        AnalyticScene([], BOX)
    with pytest.raises(ValueError, match="box must"):
        AnalyticScene([body], ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="density must be > 0"):
        Body(Ball(0.5), Plain(RED), density=0.0)
    scene = AnalyticScene([body], BOX)
    with pytest.raises(ValueError, match=r"times must have shape \(4,\), got \(4, 1\)"):
        scene.density(torch.zeros(4, 3), torch.zeros(4, 1))
    with pytest.raises(ValueError, match="directions must have shape"):
        scene(torch.zeros(4, 3), torch.zeros(3), torch.zeros(4))
