"""Exact motion vectors, occlusion and tracks against independent ways: rays marched through bodies, re-rendering."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, camera_rays, look_at
from dnerf.data import render_exact
from dnerf.scenes import SCENES, AnalyticScene, Ball, Body, Plain, Slide, Wave, make_scene
from dnerf.scenes.exact_motion import ExactFlow, exact_flow, exact_tracks

INTRINSICS = Intrinsics.from_angle(40, 30, 0.7)
FIRST = Camera(INTRINSICS, look_at((3.6, 0.4, 1.6)))
SECOND = Camera(INTRINSICS, look_at((3.4, 1.1, 1.9)))
EYES = [camera.pose[:3, 3].double() for camera in (FIRST, SECOND)]
T0, T1 = 0.37, 0.46

OCCLUDING = {"glossy_ball", "orbiting_balls", "walker"}
"""Scenes in which some points of the first image are hidden in the second; others show that none is."""


@pytest.fixture
def flow(scene: AnalyticScene) -> ExactFlow:
    return exact_flow(scene, FIRST, T0, SECOND, T1)


def of_bodies(flow: ExactFlow, every: int = 1) -> tuple[Tensor, ...]:
    """Pixels (N, 2), vectors, positions, moved positions and visibility where the first image shows a body."""
    rows, columns = (flow.owners >= 0).nonzero()[::every].unbind(-1)
    values = (value[rows, columns] for value in (flow.vectors, flow.positions, flow.moved, flow.visible))
    return torch.stack([columns, rows], dim=-1).double(), *values


def march(scene: AnalyticScene, origin: Tensor, target: Tensor, time: float, steps: int = 4000) -> Tensor:
    """Along segments from an eye (3,) to points (N, 3): share of the way at which a body first is, 2 if nowhere."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:-1]
    first = []
    for point in target:
        inside = scene.contains(origin + share[:, None] * (point - origin), torch.full_like(share, time)).any(-1)
        first.append(torch.cat([share[inside], torch.tensor([2.0])])[0])
    return torch.stack(first)


def pinhole(camera: Camera, points: Tensor) -> np.ndarray:
    """Column and row by textbook matrices, written without the package: x = K [R | t] X with OpenCV axes."""
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(camera.pose.double().numpy())
    lens = camera.intrinsics
    matrix = np.array([[lens.focal_x, 0, lens.width / 2], [0, lens.focal_y, lens.height / 2], [0, 0, 1]])
    homogeneous = np.concatenate([points.numpy(), np.ones((len(points), 1))], axis=1)
    image = matrix @ (world_to_camera @ homogeneous.T)[:3]
    return (image[:2] / image[2]).T - 0.5


def test_vectors_are_the_projections_of_moved_points(scene: AnalyticScene, flow: ExactFlow) -> None:
    here, vectors, positions, moved, _ = of_bodies(flow)
    assert 50 < len(here) < flow.owners.numel()
    np.testing.assert_allclose(pinhole(FIRST, positions), here, atol=1e-5)  # poses are float32
    np.testing.assert_allclose(pinhole(SECOND, moved), here + vectors, atol=1e-5)
    # The scene's own advection, a little inside the surface, agrees: who owns the point was found by ray casting.
    nudge = 1e-7 * torch.nn.functional.normalize(positions - EYES[0], dim=-1)
    close = (scene.advect(positions + nudge, T0, T1) - moved).norm(dim=-1) < 1e-6
    assert close.double().mean() > 0.98  # a nudge at grazing incidence may leave the body or enter its neighbour


def test_visible_surfaces_are_the_first_on_the_way(scene: AnalyticScene, flow: ExactFlow) -> None:
    points = of_bodies(flow, 7)[2]
    nothing_before = march(scene, EYES[0], points, T0) > 1
    assert nothing_before.double().mean() > 0.99  # but the surface, to rounding
    first = march(scene, EYES[0], EYES[0] + 1.002 * (points - EYES[0]), T0)
    # Right behind it is a body; rays that only graze may leave it within 0.002 of the way.
    assert ((first > 0.997) & (first < 1)).double().mean() > 0.98


def test_visibility_agrees_with_rays_marched_through_the_second_image(
    name: str, scene: AnalyticScene, flow: ExactFlow
) -> None:
    _, _, _, moved, visible = of_bodies(flow, 5)
    blocked = march(scene, EYES[1], moved, T1) < 1 - 1e-3  # a surface's own fog within 0.004 of it does not count
    assert bool(blocked.any()) or name not in OCCLUDING
    inside = ((pinhole(SECOND, moved) >= -0.5) & (pinhole(SECOND, moved) <= np.array([39.5, 29.5]))).all(-1)
    # Points at silhouettes graze their own body closer than the march's steps of 0.001: one of 22 in the worst scene.
    assert (visible == ~blocked & torch.from_numpy(inside)).double().mean() > 0.95


def test_tracks_are_the_vectors_of_every_time(scene: AnalyticScene) -> None:
    views = [(FIRST, T0), (SECOND, T1), (FIRST, 0.9)]
    pixels = torch.tensor([[20.0, 15.0], [18.0, 17.0], [22.0, 13.0], [20.0, 22.0], [0.0, 0.0]])
    tracks = exact_tracks(scene, *zip(*views), pixels)
    for index, (camera, time) in enumerate(views):
        flow = exact_flow(scene, FIRST, T0, camera, time)
        columns, rows = pixels.long().unbind(-1)
        kept = flow.owners[rows, columns] >= 0
        assert 0 < kept.sum() == tracks.positions.shape[1] < len(pixels)
        there, moved, visible = (x[rows, columns][kept] for x in (flow.vectors, flow.moved, flow.visible))
        torch.testing.assert_close(tracks.pixels[index], there + pixels[kept], rtol=0, atol=1e-9)
        torch.testing.assert_close(tracks.positions[index], moved, rtol=0, atol=1e-12)
        assert torch.equal(tracks.visible[index], visible)


@pytest.mark.parametrize("name", ["orbiting_balls", "static", "walker"])
def test_points_have_their_colour_where_the_vectors_lead(name: str) -> None:
    """Rendered again through the fractional pixel of the second image; dense bodies, so that their skin is thin."""
    scene = SCENES[name](density=1e5)
    here, vectors, _, _, visible = of_bodies(exact_flow(scene, FIRST, T0, SECOND, T1))

    def colour(camera: Camera, pixels: Tensor, time: float) -> Tensor:
        columns, rows = pixels[visible].unbind(-1)
        times = torch.full_like(rows, time)
        rays = camera_rays(INTRINSICS, camera.pose.double(), columns, rows, times=times, near=2.0, far=6.0)
        return render_exact(scene, rays)[0]

    right, wrong = (
        (colour(FIRST, here, T0) - colour(SECOND, there, T1)).abs().amax(-1)
        for there in (here + vectors, here - vectors)
    )
    # Light comes from 1e-5 deep; edges between two colours and grazing rays mix.
    assert right.quantile(0.97) < 1e-3
    assert wrong.quantile(0.97) > 0.1


def sliding_ball(amplitude: float) -> tuple[Camera, ExactFlow]:
    """A ball of radius 0.5 that slides along y, by the amplitude from t = 0 to 1/4, before a camera at x = 4."""
    motion = Slide(Wave(0.0, ((amplitude, 1.0, 0.0),)), (0.0, 1.0, 0.0))
    scene = AnalyticScene([Body(Ball(0.5), Plain((1.0, 0.0, 0.0)), motion)], box=[[-1, -2, -1], [1, 2, 1]])
    camera = Camera(Intrinsics.from_angle(41, 41, 0.7), look_at((4.0, 0.0, 0.0)), 0.5, 8.0)
    return camera, exact_flow(scene, camera, 0.0, camera, 0.25)


def test_closed_form_of_a_sliding_ball() -> None:
    camera, flow = sliding_ball(0.3)
    # Seen from +x with z up, y points to the right; the nearest point is 3.5 away in both images.
    assert flow.positions[20, 20].tolist() == pytest.approx([0.5, 0.0, 0.0], abs=1e-6)
    assert flow.moved_depth[20, 20].item() == pytest.approx(math.hypot(3.5, 0.3), abs=1e-6)
    assert flow.vectors[20, 20].tolist() == pytest.approx([camera.intrinsics.focal_x * 0.3 / 3.5, 0.0], abs=1e-5)
    assert torch.isnan(flow.vectors[0, 0]).all()
    assert not flow.visible[0, 0]


def test_a_point_that_leaves_the_image_is_not_visible() -> None:
    _, flow = sliding_ball(3.0)
    assert flow.vectors[20, 20, 0] > 20
    assert not flow.visible.any()


def test_standing_still_is_no_motion() -> None:
    _, vectors, _, _, visible = of_bodies(exact_flow(make_scene("static"), FIRST, 0.2, FIRST, 0.9))
    assert vectors.abs().max() < 1e-5
    assert visible.all()


def test_motion_there_and_back_is_none() -> None:
    scene = make_scene("glossy_ball")
    here, vectors, _, _, visible = of_bodies(exact_flow(scene, FIRST, T0, SECOND, T1))
    back = exact_tracks(scene, [SECOND, FIRST], [T1, T0], (here + vectors)[visible])
    assert back.pixels.shape[1] >= 0.99 * visible.sum()  # a point on a silhouette may be missed by its ray
    distance = torch.cdist(back.pixels[1], here[visible]).amin(-1)
    assert distance.quantile(0.98) < 1e-5
    assert back.visible[1].double().mean() > 0.98


def test_what_cannot_be_followed_is_named() -> None:
    scene = make_scene("static")
    with pytest.raises(ValueError, match=r"pixels must show a body at time 0\.0, none of 1 does"):
        exact_tracks(scene, [FIRST], [0.0], torch.zeros(1, 2))
    with pytest.raises(ValueError, match="cameras and times must be equally many"):
        exact_tracks(scene, [FIRST], [0.0, 0.5], torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"pixels must have shape \(P, 2\)"):
        exact_tracks(scene, [FIRST], [0.0], torch.zeros(2))
