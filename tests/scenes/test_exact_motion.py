"""Exact motion vectors, occlusion and tracks against independent roads: rays marched through matter, re-rendering."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, camera_rays, look_at
from dnerf.data import render_exact
from dnerf.rays import Rays
from dnerf.scenes import (
    SCENES,
    AnalyticScene,
    Ball,
    Body,
    Plain,
    Slide,
    Wave,
    exact_flow,
    exact_tracks,
    first_surfaces,
    make_glossy_ball,
    make_orbiting_balls,
    make_scene,
    make_static,
    make_walker,
)

INTRINSICS = Intrinsics.from_angle(40, 30, 0.7)
FIRST = Camera(INTRINSICS, look_at((3.6, 0.4, 1.6)))
SECOND = Camera(INTRINSICS, look_at((3.4, 1.1, 1.9)))
T0, T1 = 0.37, 0.46

OCCLUDING = {"glossy_ball", "orbiting_balls", "walker"}
"""Scenes in which some matter of the first picture is hidden in the second; others show that none is."""

every_scene = pytest.mark.parametrize("name", sorted(SCENES))


def march(scene: AnalyticScene, origin: Tensor, target: Tensor, time: float, steps: int = 4000) -> Tensor:
    """Along segments from an eye (3,) to points (N, 3): share of the way at which matter first is, 2 if nowhere."""
    share = torch.linspace(0, 1, steps + 1, dtype=torch.float64)[:-1]
    first = []
    for point in target:
        places = origin + share[:, None] * (point - origin)
        inside = scene.contains(places, torch.full_like(share, time)).any(-1)
        first.append(share[inside.nonzero()[0, 0]] if bool(inside.any()) else torch.tensor(2.0, dtype=torch.float64))
    return torch.stack(first)


def pinhole(camera: Camera, points: Tensor) -> np.ndarray:
    """Column and row by textbook matrices, written without the package: x = K [R | t] X with OpenCV axes."""
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(camera.pose.double().numpy())
    seen = camera.intrinsics
    matrix = np.array([[seen.focal_x, 0, seen.width / 2], [0, seen.focal_y, seen.height / 2], [0, 0, 1]])
    homogeneous = np.concatenate([points.numpy(), np.ones((len(points), 1))], axis=1)
    image = matrix @ (world_to_camera @ homogeneous.T)[:3]
    return (image[:2] / image[2]).T - 0.5


@every_scene
def test_vectors_are_the_projections_of_moved_matter(name: str) -> None:
    scene = make_scene(name)
    flow = exact_flow(scene, FIRST, T0, SECOND, T1)
    matter = flow.owners >= 0
    assert 50 < matter.sum() < matter.numel()
    rows, columns = matter.nonzero().unbind(-1)
    here = torch.stack([columns, rows], dim=-1).double()
    np.testing.assert_allclose(pinhole(FIRST, flow.positions[matter]), here, atol=1e-5)  # poses are float32
    np.testing.assert_allclose(pinhole(SECOND, flow.moved[matter]), here + flow.vectors[matter], atol=1e-5)
    # The scene's own advection, asked a little inside the surface, agrees: who owns the point was found by ray casting.
    inward = flow.positions[matter] - FIRST.pose[:3, 3].double()
    nudge = 1e-7 * inward / inward.norm(dim=-1, keepdim=True)
    moved = scene.advect(flow.positions[matter] + nudge, T0, T1)
    close = (moved - flow.moved[matter]).norm(dim=-1) < 1e-6
    assert close.double().mean() > 0.98  # a nudge at grazing incidence may leave the body or enter its neighbour


@every_scene
def test_seen_surfaces_are_the_first_matter_on_the_way(name: str) -> None:
    scene = make_scene(name)
    flow = exact_flow(scene, FIRST, T0, SECOND, T1)
    matter = flow.owners >= 0
    chosen = matter.flatten().nonzero()[:, 0][::7]
    eye = FIRST.pose[:3, 3].double()
    points = flow.positions.reshape(-1, 3)[chosen]
    assert (march(scene, eye, points, T0) > 1).double().mean() > 0.99  # nothing in front (but the surface, to rounding)
    beyond = eye + 1.002 * (points - eye)
    first = march(scene, eye, beyond, T0)
    # Right behind it is matter; rays that only graze may leave it within 0.002 of the way.
    assert ((first > 0.997) & (first < 1)).double().mean() > 0.98


@every_scene
def test_visibility_agrees_with_rays_marched_through_the_second_picture(name: str) -> None:
    scene = make_scene(name)
    flow = exact_flow(scene, FIRST, T0, SECOND, T1)
    matter = (flow.owners >= 0).flatten()
    chosen = matter.nonzero()[:, 0][::5]
    moved, said = flow.moved.reshape(-1, 3)[chosen], flow.visible.flatten()[chosen]
    eye = SECOND.pose[:3, 3].double()
    blocked = march(scene, eye, moved, T1) < 1 - 1e-3  # a surface's own fog within 0.004 of it does not count
    assert bool(blocked.any()) or name not in OCCLUDING
    inside = ((pinhole(SECOND, moved) >= -0.5) & (pinhole(SECOND, moved) <= np.array([39.5, 29.5]))).all(-1)
    expected = ~blocked & torch.from_numpy(inside)
    # Points at silhouettes graze their own body closer than the march's steps of 0.001: one of 22 in the worst scene.
    assert (said == expected).double().mean() > 0.95


DENSE = {
    "orbiting_balls": lambda: make_orbiting_balls(density=1e5),
    "static": lambda: make_static(density=1e5),
    "walker": lambda: make_walker(density=1e5),
}


@pytest.mark.parametrize("name", DENSE)
def test_matter_has_its_colour_where_the_vectors_lead(name: str) -> None:
    """Rendered again through the fractional pixel of the second picture; dense bodies, so that their skin is thin."""
    scene = DENSE[name]()
    flow = exact_flow(scene, FIRST, T0, SECOND, T1)
    visible = flow.visible & (flow.owners >= 0)
    rows, columns = visible.nonzero().unbind(-1)
    here = torch.stack([columns, rows], dim=-1).double()
    there = here + flow.vectors[visible]

    def colour(camera: Camera, pixels: Tensor, time: float) -> Tensor:
        times = torch.full((len(pixels),), time, dtype=torch.float64)
        rays = camera_rays(INTRINSICS, camera.pose.double(), pixels[:, 0], pixels[:, 1], times=times, near=2.0, far=6.0)
        return render_exact(scene, rays)[0]

    difference = (colour(FIRST, here, T0) - colour(SECOND, there, T1)).abs().amax(-1)
    # Seen 1e-5 deep; edges between two colours and grazing rays mix.
    assert difference.quantile(0.97) < 1e-3
    # The same vectors the other way round must not do.
    wrong = (colour(FIRST, here, T0) - colour(SECOND, here - flow.vectors[visible], T1)).abs().amax(-1)
    assert wrong.quantile(0.97) > 0.1


def test_hidden_matter_shows_another_colour_or_body() -> None:
    scene = make_orbiting_balls(density=1e5)
    flow = exact_flow(scene, FIRST, 0.1, FIRST, 0.3)
    hidden = ~flow.visible & (flow.owners >= 0)
    assert hidden.sum() > 20
    eye = FIRST.pose[:3, 3].double()
    offsets = flow.moved[hidden] - eye
    lengths = offsets.norm(dim=-1)
    times = torch.full_like(lengths, 0.3)
    rays = Rays(eye.expand_as(offsets), offsets / lengths[:, None], times, 0 * lengths, lengths + 3)
    assert (first_surfaces(scene, rays).distances < lengths).all()


def one_ball(amplitude: float) -> AnalyticScene:
    """A ball of radius 0.5 that slides along y: y(t) = amplitude sin(2 pi t)."""
    motion = Slide(axis=(0.0, 1.0, 0.0), distance=Wave(0.0, ((amplitude, 1.0, 0.0),)))
    return AnalyticScene([Body(Ball(0.5), Plain((1.0, 0.0, 0.0)), motion)], box=[[-1, -2, -1], [1, 2, 1]])


def test_closed_form_of_a_sliding_ball() -> None:
    camera = Camera(Intrinsics.from_angle(41, 41, 0.7), look_at((4.0, 0.0, 0.0)), 0.5, 8.0)
    flow = exact_flow(one_ball(0.3), camera, 0.0, camera, 0.25)
    focal = camera.intrinsics.focal_x
    torch.testing.assert_close(flow.depth[20, 20].item(), 3.5, rtol=0, atol=1e-6)
    # Seen from +x with z up, y points to the right; the nearest point is 3.5 away in both pictures.
    expected = torch.tensor([focal * 0.3 / 3.5, 0.0], dtype=torch.float64)
    torch.testing.assert_close(flow.vectors[20, 20], expected, rtol=0, atol=1e-5)
    assert flow.moved_depth[20, 20].item() == pytest.approx(math.hypot(3.5, 0.3), abs=1e-6)
    assert torch.isnan(flow.vectors[0, 0]).all()
    assert not flow.visible[0, 0]


def test_matter_that_leaves_the_picture_is_not_visible() -> None:
    camera = Camera(Intrinsics.from_angle(41, 41, 0.7), look_at((4.0, 0.0, 0.0)), 0.5, 8.0)
    flow = exact_flow(one_ball(3.0), camera, 0.0, camera, 0.25)
    assert flow.vectors[20, 20, 0] > 20
    assert not flow.visible.any()


def test_standing_still_is_no_motion() -> None:
    flow = exact_flow(make_scene("static"), FIRST, 0.2, FIRST, 0.9)
    matter = flow.owners >= 0
    assert flow.vectors[matter].abs().max() < 1e-5
    assert flow.visible[matter].all()


def test_motion_there_and_back_is_none() -> None:
    scene = make_glossy_ball()
    there = exact_flow(scene, FIRST, T0, SECOND, T1)
    pixels = torch.stack(torch.meshgrid(torch.arange(40), torch.arange(30), indexing="xy"), dim=-1) + there.vectors
    chosen = pixels[there.visible]
    back = exact_tracks(scene, [SECOND, FIRST], [T1, T0], chosen)
    rows, columns = there.visible.nonzero().unbind(-1)
    found = back.pixels[1]
    assert len(found) >= 0.99 * len(chosen)  # a point on a silhouette may be missed by its ray
    if len(found) == len(chosen):
        error = (found - torch.stack([columns, rows], dim=-1)).norm(dim=-1)
        assert error.quantile(0.98) < 1e-5
        assert back.visible[1].double().mean() > 0.98


@every_scene
def test_tracks_are_the_vectors_of_every_time(name: str) -> None:
    scene = make_scene(name)
    times = [T0, T1, 0.9]
    pixels = torch.tensor([[20.0, 15.0], [18.0, 17.0], [22.0, 13.0], [20.0, 22.0], [0.0, 0.0]])
    tracks = exact_tracks(scene, [FIRST, SECOND, FIRST], times, pixels)
    for index, (camera, time) in enumerate(zip([FIRST, SECOND, FIRST], times)):
        flow = exact_flow(scene, FIRST, T0, camera, time)
        chosen = [(int(row), int(column)) for column, row in pixels.tolist() if flow.owners[int(row), int(column)] >= 0]
        assert 0 < len(chosen) == tracks.positions.shape[1] < len(pixels)
        for k, (row, column) in enumerate(chosen):
            there = flow.vectors[row, column] + torch.tensor([column, row])
            torch.testing.assert_close(tracks.pixels[index, k], there, rtol=0, atol=1e-9)
            torch.testing.assert_close(tracks.positions[index, k], flow.moved[row, column], rtol=0, atol=1e-12)
            assert tracks.visible[index, k] == flow.visible[row, column]


def test_what_cannot_be_followed_is_named() -> None:
    scene = make_scene("static")
    with pytest.raises(ValueError, match=r"pixels must show matter at time 0\.0, none of 1 does"):
        exact_tracks(scene, [FIRST], [0.0], torch.zeros(1, 2))
    with pytest.raises(ValueError, match="cameras and times must be equally many"):
        exact_tracks(scene, [FIRST], [0.0, 0.5], torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"pixels must have shape \(P, 2\)"):
        exact_tracks(scene, [FIRST], [0.0], torch.zeros(2))
