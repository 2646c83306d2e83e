"""Warps: invertible, volume-preserving, bounded as they say; crossings of bent bodies are complete."""

import math

import pytest
import torch
from brute_force import make_rays

from dnerf.data import render_exact
from dnerf.scenes import AnalyticScene, Ball, Bend, Body, Box, Capsule, Fixed, Plain, Twist, Vanish, Wave

WARPS = [Twist(Wave(0.0, ((1.5, 1.0, 0.0),))), Bend(Wave(0.2, ((0.7, 1.0, 0.0),)))]
SHAPES = [Ball(0.4), Box((0.2, 0.3, 0.7)), Capsule(0.2, (0.1, 0.2, 0.6))]
WHITE = Plain((1.0, 1.0, 1.0))

every_warp = pytest.mark.parametrize("warp", WARPS, ids=lambda w: type(w).__name__)


def points(count: int) -> torch.Tensor:
    return 2 * torch.rand(count, 3, dtype=torch.float64) - 1


def jacobians(function, x: torch.Tensor) -> torch.Tensor:
    return torch.autograd.functional.jacobian(lambda p: function(p).sum(0), x).permute(1, 0, 2)


def close(found: torch.Tensor, expected: list[float], tolerance: float = 1e-12) -> None:
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=tolerance)


@every_warp
def test_warps_are_undone_and_change_no_volume(warp):
    x, times = points(500), torch.rand(500, dtype=torch.float64)
    pose = warp.pose(times)
    torch.testing.assert_close(pose.to_local(pose.to_world(x)), x, rtol=0, atol=1e-14)
    assert (pose.to_world(x) - x).norm(dim=-1).max() > 0.3
    close(torch.linalg.det(jacobians(pose.to_world, x)), [1.0] * 500, 1e-13)


@every_warp
def test_stretch_and_reach_are_bounds(warp):
    pose, x = warp.pose(torch.rand(2000, dtype=torch.float64)), points(2000)
    inside = x.norm(dim=-1) <= 1
    stretch = torch.linalg.matrix_norm(jacobians(pose.to_local, x), ord=2)
    assert (stretch <= warp.stretch(pose.amount, 1.0))[inside].all()
    for shape in SHAPES:
        held = shape.contains(x)
        assert (pose.to_world(x)[held].norm(dim=-1) <= warp.reach(shape)).all()


def scene_of(shape, motion, density: float = 1.0) -> AnalyticScene:
    return AnalyticScene([Body(shape, WHITE, motion, density)], ((-2,) * 3, (2,) * 3))


def test_a_ray_crosses_a_bent_rod_twice_where_the_parabola_says():
    a, thickness = 0.7, 0.1
    scene = scene_of(Box((thickness, 0.2, 0.9)), Bend(Wave(a)), 2.0)
    samples = scene.exact_samples(make_rays([[0.3, 0.0, -3.0]], [[0.0, 0.0, 1.0]]))
    # inside where |0.3 - a z^2| <= thickness
    low, high = math.sqrt((0.3 - thickness) / a), math.sqrt((0.3 + thickness) / a)
    begins = samples.starts[torch.cat([torch.tensor([True]), samples.starts[1:] > samples.ends[:-1] + 1e-9])]
    close(begins, [3 - high, 3 + low])
    close(samples.lengths.sum(), 2 * (high - low))


@pytest.mark.parametrize(
    ("warp", "chords"), [(Bend(Wave(0.5)), [0.4, 2 * math.sqrt(0.3 / 0.5)]), (Twist(Wave(0.0)), [0.4, 1.6])]
)
def test_warped_body_is_the_straight_one_along_lines_that_the_warp_leaves_alone(warp, chords):
    lines = make_rays([[0.05, -3.0, 0.4], [0.0, 0.0, -3.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    samples = scene_of(Box((0.3, 0.2, 0.8)), warp).exact_samples(lines)
    close(torch.zeros(2).double().index_add(0, samples.ray_indices, samples.lengths), chords)


def test_camera_inside_a_twisted_body_sees_from_where_it_is():
    scene = scene_of(Box((0.5, 0.5, 0.5)), Twist(Wave(1.0)))
    _, opacity, _ = render_exact(scene, make_rays([[0.0, 0.0, 0.1]], [[0.0, 0.0, 1.0]]))
    close(opacity, [-math.expm1(-0.4)], 1e-13)


def test_warps_have_parents_and_keep_their_presence():
    parent = Vanish((0.4, 0.6), parent=Fixed((1.0, 0.0, 0.0)))
    times, local = torch.tensor([0.1, 0.5], dtype=torch.float64), points(2)
    pose = Twist(Wave(1.0), parent=parent).pose(times)
    straight = Twist(Wave(1.0)).pose(times).to_world(local)
    torch.testing.assert_close(pose.to_world(local), straight + torch.tensor([1.0, 0, 0]))
    assert pose.presence.tolist() == [1, 0]
    assert pose.take(torch.tensor([1, 1, 0])).presence.tolist() == [0, 0, 1]


def test_a_vanished_body_is_not_there():
    scene = scene_of(Ball(0.5), Vanish((0.4, 0.6)), 3.0)
    times = torch.tensor([0.39, 0.4, 0.59, 0.6])
    assert scene.density(torch.zeros(4, 3), times).tolist() == [3, 0, 0, 3]
    assert scene.body_indices(torch.zeros(4, 3), times).tolist() == [0, -1, -1, 0]
    assert len(scene.exact_samples(make_rays([[0.0, 0.0, -3.0]], [[0.0, 0.0, 1.0]], times=0.5)).starts) == 0
