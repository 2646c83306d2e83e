"""Warps: invertible, volume-preserving, bounded as they say; crossings of bent bodies are complete."""

import math

import pytest
import torch

from dnerf.compositing import composite
from dnerf.rays import Rays
from dnerf.scenes import AnalyticScene, Ball, Bend, Body, Box, Capsule, Jump, Plain, Twist, Vanish, Wave
from dnerf.scenes.motions import Fixed

WARPS = [Twist(Wave(0.0, ((1.5, 1.0, 0.0),))), Bend(Wave(0.2, ((0.7, 1.0, 0.0),)))]
SHAPES = [Ball(0.4), Box((0.2, 0.3, 0.7)), Capsule(0.2, (0.1, 0.2, 0.6))]


def points(count: int, size: float = 1.0) -> torch.Tensor:
    return size * (2 * torch.rand(count, 3, dtype=torch.float64) - 1)


@pytest.mark.parametrize("warp", WARPS, ids=lambda w: type(w).__name__)
def test_warps_are_undone_and_change_no_volume(warp):
    x, times = points(500), torch.rand(500, dtype=torch.float64)
    pose = warp.pose(times)
    torch.testing.assert_close(pose.to_local(pose.to_world(x)), x, rtol=0, atol=1e-14)
    assert (pose.to_world(x) - x).norm(dim=-1).max() > 0.3
    jacobians = torch.autograd.functional.jacobian(lambda p: pose.to_world(p).sum(0), x).permute(1, 0, 2)
    torch.testing.assert_close(torch.linalg.det(jacobians), torch.ones(500).double(), rtol=0, atol=1e-13)


@pytest.mark.parametrize("warp", WARPS, ids=lambda w: type(w).__name__)
def test_stretch_and_reach_are_bounds(warp):
    times = torch.rand(2000, dtype=torch.float64)
    pose = warp.pose(times)
    x = points(2000)
    inside = x.norm(dim=-1) <= 1
    jacobians = torch.autograd.functional.jacobian(lambda p: pose.to_local(p).sum(0), x).permute(1, 0, 2)
    stretch = torch.linalg.matrix_norm(jacobians, ord=2)
    assert (stretch <= warp.stretch(pose.amount, 1.0))[inside].all()
    for shape in SHAPES:
        local = points(4000)[: len(times)]
        held = shape.contains(local)
        assert (pose.to_world(local)[held].norm(dim=-1) <= warp.reach(shape)).all()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_excess_has_the_sign_of_inside_and_slope_at_most_one(shape):
    a, b = points(3000), points(3000)
    assert torch.equal(shape.excess(a) <= 0, shape.contains(a))
    difference = (shape.excess(a) - shape.excess(b)).abs()
    assert (difference <= (a - b).norm(dim=-1) + 1e-15).all()


def rays(origins, directions, time=0.25) -> Rays:
    o = torch.tensor(origins, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.tensor(directions, dtype=torch.float64), dim=-1)
    n = len(o)
    full = torch.full((n,), time, dtype=torch.float64)
    return Rays(o, d, full, 0 * full, 0 * full + 10)


def test_a_ray_crosses_a_bent_rod_twice_where_the_parabola_says():
    a, thickness = 0.7, 0.1
    rod = Body(Box((thickness, 0.2, 0.9)), Plain((1.0, 0.0, 0.0)), Bend(Wave(a)), 2.0)
    samples = AnalyticScene([rod], ((-1, -1, -1), (2, 1, 1))).exact_samples(rays([[0.3, 0.0, -3.0]], [[0.0, 0.0, 1.0]]))
    # inside where |0.3 - a z^2| <= thickness
    low, high = math.sqrt((0.3 - thickness) / a), math.sqrt((0.3 + thickness) / a)
    begins = samples.starts[torch.cat([torch.tensor([True]), samples.starts[1:] > samples.ends[:-1] + 1e-9])]
    torch.testing.assert_close(begins, torch.tensor([3 - high, 3 + low], dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(
        samples.lengths.sum(), torch.tensor(2 * (high - low), dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_warped_body_is_the_straight_one_along_lines_that_the_warp_leaves_alone():
    box = Box((0.3, 0.2, 0.8))
    o, d = [[0.05, -3.0, 0.4], [0.0, 0.0, -3.0]], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    for warp, chord in ((Bend(Wave(0.5)), [0.4, 2 * math.sqrt(0.3 / 0.5)]), (Twist(Wave(0.0)), [0.4, 1.6])):
        scene = AnalyticScene([Body(box, Plain((1.0, 1.0, 1.0)), warp, 1.0)], ((-2, -2, -2), (2, 2, 2)))
        samples = scene.exact_samples(rays(o, d))
        lengths = torch.zeros(2).double().index_add(0, samples.ray_indices, samples.lengths)
        torch.testing.assert_close(lengths, torch.tensor(chord, dtype=torch.float64), rtol=0, atol=1e-12)


def test_camera_inside_a_twisted_body_sees_from_where_it_is():
    scene = AnalyticScene(
        [Body(Box((0.5, 0.5, 0.5)), Plain((1.0, 1.0, 1.0)), Twist(Wave(1.0)), 1.0)], ((-1, -1, -1), (1, 1, 1))
    )
    ray = rays([[0.0, 0.0, 0.1]], [[0.0, 0.0, 1.0]])
    samples = scene.exact_samples(ray)
    opacity = composite(samples, scene(*samples.locate(ray))).opacity
    torch.testing.assert_close(opacity, -torch.expm1(torch.tensor([-0.4], dtype=torch.float64)), rtol=0, atol=1e-13)


def test_warps_have_parents_and_keep_their_presence():
    parent = Vanish((0.4, 0.6), Fixed((1.0, 0.0, 0.0)))
    pose = Twist(Wave(1.0), parent).pose(torch.tensor([0.1, 0.5], dtype=torch.float64))
    local = points(2)
    straight = Twist(Wave(1.0)).pose(torch.tensor([0.1, 0.5], dtype=torch.float64)).to_world(local)
    torch.testing.assert_close(pose.to_world(local), straight + torch.tensor([1.0, 0, 0]))
    assert pose.presence.tolist() == [1, 0]
    assert pose.take(torch.tensor([1, 1, 0])).presence.tolist() == [0, 0, 1]


def test_a_vanished_body_is_not_there():
    scene = AnalyticScene([Body(Ball(0.5), Plain((1.0, 0.0, 0.0)), Vanish((0.4, 0.6)), 3.0)], ((-1,) * 3, (1,) * 3))
    times = torch.tensor([0.39, 0.4, 0.59, 0.6])
    assert scene.density(torch.zeros(4, 3), times).tolist() == [3, 0, 0, 3]
    assert scene.body_indices(torch.zeros(4, 3), times).tolist() == [0, -1, -1, 0]
    assert len(scene.exact_samples(rays([[0.0, 0.0, -3.0]], [[0.0, 0.0, 1.0]], time=0.5)).starts) == 0


def test_jumps_stand_still_in_between_and_come_back():
    places = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    shifts = Jump(places).pose(torch.tensor([0.0, 0.49, 0.5, 0.99, 1.0])).translation[:, 0]
    assert shifts.tolist() == [0, 0, 1, 1, 0]


@pytest.mark.parametrize("gone", [(0.0, 0.5), (0.6, 0.4), (0.5, 1.0)])
def test_times_of_absence_are_checked(gone):
    with pytest.raises(ValueError, match="gone must be two increasing times"):
        Vanish(gone)


def test_jumps_need_places():
    with pytest.raises(ValueError, match="places must hold at least one"):
        Jump(())
