"""Compositing of exact samples against images written down by hand."""

import math
from itertools import pairwise

import pytest
import torch
from brute_force import START, make_rays
from torch import Tensor

from dnerf.core.rays import Rays
from dnerf.data import render_exact
from dnerf.scenes import AnalyticScene, Ball, Body, Box, Checker, Fixed, Gradient, Plain, Pulse, Wave
from dnerf.scenes.textures import grid_planes

TOLERANCES = {torch.float64: 1e-12, torch.float32: 1e-6}
BOX = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
RED, GREEN, BLUE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def render(bodies: list[Body], rays: Rays, background=(0.0, 0.0, 0.0)) -> tuple[Tensor, Tensor, Tensor]:
    return render_exact(AnalyticScene(bodies, BOX), rays, torch.tensor(background, dtype=rays.origins.dtype))


def slab(half: float, color: tuple[float, float, float], x: float, density: float) -> Body:
    return Body(Box((half, 1.0, 1.0)), Plain(color), Fixed((x, 0.0, 0.0)), density)


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
    rays = make_rays([[-1.5, offset, 0.0]]).to(dtype)
    rgb, found, distance = render([Body(Ball(0.7), Plain(RED), density=density)], rays, (0.0, 1.0, 1.0))
    half = math.sqrt(0.49 - offset**2)
    opacity, tolerance = -math.expm1(-2 * half * density), TOLERANCES[dtype]
    assert found.item() == pytest.approx(opacity, abs=tolerance, rel=tolerance)
    assert rgb[0].tolist() == pytest.approx([opacity, 1 - opacity, 1 - opacity], abs=tolerance)
    # Distances are larger than 1.
    assert distance.item() == pytest.approx(absorbed_at(1.5 - half, 2 * half, density), abs=3 * tolerance)


@pytest.mark.parametrize("density", [50.0, 1e3, 1e6, 1e9])
def test_opaque_ball_shows_its_surface(density: float) -> None:
    ball = Body(Ball(0.7), Gradient(RED, BLUE, (1.0, 0.0, 0.0)), density=density)
    rgb, opacity, distance = render([ball], make_rays())
    assert opacity.item() == pytest.approx(1, abs=1e-14)
    assert distance.item() == pytest.approx(1.3 + 1 / density, abs=1e-14)
    blue = 0.5 / (0.7 * density)  # mean of a colour linear in depth: that at the mean depth 1 / density
    assert rgb[0].tolist() == pytest.approx([1 - blue, 0.0, blue], abs=1e-14)


@pytest.mark.parametrize("density", [1e-6, 0.1, 1.0, 4.0, 30.0, 300.0])
def test_linear_color_is_that_at_the_expected_depth(density: float) -> None:
    rays = make_rays([[-2.0, 0.1, -0.3]], [[1.0, 0.05, 0.2]])
    ball = Body(Ball(0.7), Gradient(RED, BLUE, (0.6, 0.0, 0.8)), density=density)
    rgb, opacity, distance = render([ball], rays)
    mean = rays.origins + distance[:, None] * rays.directions
    share = 0.5 + 0.5 * (0.6 * mean[0, 0] + 0.8 * mean[0, 2]).item() / 0.7
    assert (rgb[0] / opacity).tolist() == pytest.approx([1 - share, 0, share], abs=1e-14 / opacity.item())


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("swapped", [False, True])
def test_two_slabs_hide_each_other_in_order(swapped: bool, dtype: torch.dtype) -> None:
    first, second = (GREEN, RED) if swapped else (RED, GREEN)
    slabs = [slab(0.25, second, 0.5, 3.0), slab(0.5, first, -0.5, 0.8)]
    rgb, _, distance = render(slabs, make_rays().to(dtype), BLUE)
    near, far = -math.expm1(-0.8), math.exp(-0.8) * -math.expm1(-1.5)
    expected = [far, near, math.exp(-2.3)] if swapped else [near, far, math.exp(-2.3)]
    assert rgb[0].tolist() == pytest.approx(expected, abs=TOLERANCES[dtype])
    depth = (near * absorbed_at(1, 1, 0.8) + far * absorbed_at(2.25, 0.5, 3)) / (near + far)
    assert distance.item() == pytest.approx(depth, abs=3 * TOLERANCES[dtype])


def test_overlapping_bodies_add_up_and_mix() -> None:
    rgb, _, _ = render([slab(0.5, RED, -0.25, 1.0), slab(0.5, BLUE, 0.25, 3.0)], make_rays())
    first, both, last = (-math.expm1(-tau) for tau in (0.5, 2.0, 1.5))
    both, last = both * math.exp(-0.5), last * math.exp(-2.5)
    assert rgb[0].tolist() == pytest.approx([first + 0.25 * both, 0, 0.75 * both + last], abs=1e-14)


def test_checkered_slab_shows_its_cells_in_order() -> None:
    board = Checker(Plain(RED), Plain(GREEN), grid_planes(0.2, 2, "x"))
    rgb, _, _ = render([Body(Box((0.5, 1.0, 1.0)), board, density=2.0)], make_rays())
    cuts = [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0]
    weights = [math.exp(-2 * a) - math.exp(-2 * b) for a, b in pairwise(cuts)]
    assert rgb[0].tolist() == pytest.approx([sum(weights[::2]), sum(weights[1::2]), 0], abs=1e-14)


def growing(**options) -> Body:
    return Body(Ball(0.5), Plain(RED), Pulse(Wave(1.0, ((0.5, 1.0, 0.0),))), 2.0, **options)


BOTH_WAYS = make_rays([[0.1, 0.0, 0.0]] * 2, [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
GROWING = make_rays([START] * 3, times=[0.0, 0.25, 0.75])  # scales 1, 1.5, 0.5
OPTICAL_DEPTHS = {
    "cut at near and far": (slab(0.5, RED, 0.0, 2.0), make_rays(near=1.7, far=2.1), [0.8], 1e-14),
    "begins inside": (Body(Ball(0.5), Plain(RED), density=2.0), BOTH_WAYS, [0.8, 1.2], 1e-14),
    # The sheet's edges lie at distances near 2, each rounded to 2e-16.
    "thin sheet": (slab(5e-4, RED, 0.0, 100.0), make_rays(), [0.1], 1e-13),
    "thinner as it grows": (growing(conserves_mass=True), GROWING, [2.0, 2.0 / 1.5**2, 8.0], 1e-13),
    "as dense as it grows": (growing(), GROWING, [2.0, 3.0, 1.0], 1e-13),
}


@pytest.mark.parametrize("case", OPTICAL_DEPTHS)
def test_opacity_is_that_of_the_optical_depth(case: str) -> None:
    body, rays, depths, tolerance = OPTICAL_DEPTHS[case]
    opacity = render([body], rays)[1].tolist()
    assert opacity == pytest.approx([-math.expm1(-depth) for depth in depths], abs=tolerance)


def test_ray_in_a_face_or_touching_a_ball_is_finite() -> None:
    bodies = [Body(Box((0.5, 0.5, 0.5)), Plain(RED)), Body(Ball(0.5), Plain(GREEN), Fixed((0.0, 0.0, 1.0)))]
    values = render(bodies, make_rays([[-2.0, 0.5, 0.0], [-2.0, 0.5, 0.5], [-2.0, 0.0, 1.5]]))
    assert all(torch.isfinite(value).all() for value in values)
    assert values[1][2] == 0  # touches in one point


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
