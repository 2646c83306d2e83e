"""The fitted box holds everything at all times, is not much larger, and what is wrong with a box is told."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.geometry import ray_box
from dnerf.data import Frames, SyntheticData, random_views, render_frames
from dnerf.data.bounds import check_views, cut_faces, fit_box, seen_box, share_of_views
from dnerf.data.carving import hold_opaque
from dnerf.samplers import OccupiedCells
from dnerf.scenes import SCENES, make_scene

LENS = Intrinsics.from_angle(8, 8, math.radians(40))


def views(count: int = 12, channels: int = 3) -> Frames:
    """Black or clear views from the upper half space, 4 from the origin."""
    poses, times = random_views(count)
    return Frames(torch.zeros(count, 8, 8, channels, dtype=torch.uint8), poses, times, LENS)


def with_opaque(index: int, row: int, column: int) -> Frames:
    frames = views(channels=4)
    frames.images[index, row, column, 3] = 255
    return frames


def extent(name: str) -> torch.Tensor:
    """What a scene's bodies fill at any time, (2, 3), from positions drawn at random."""
    scene = make_scene(name)
    low, high = scene.box[0] - 0.2, scene.box[1] + 0.2
    positions = torch.lerp(low, high, torch.rand(200_000, 3))
    filled = positions[scene.density(positions, torch.rand(len(positions))) > 0]
    return torch.stack([filled.amin(0), filled.amax(0)])


@pytest.mark.parametrize("name", sorted(SCENES.keys() - {"courtyard"}))  # it fills what cameras outside of it see
def test_the_fitted_box_of_an_exact_scene_holds_it_at_all_times(name: str) -> None:
    frames = SyntheticData(make_scene(name), 48, num_train=20).frames("train")
    low, high = fit_box(frames)
    truth = extent(name)
    assert (low <= truth[0]).all()
    assert (high >= truth[1]).all()
    by_cameras = seen_box(frames, 0.5)
    assert float((high - low).prod()) < 0.75 * float((by_cameras[1] - by_cameras[0]).prod())


@pytest.mark.parametrize(("name", "most"), [("static", 1.3), ("merging_balls", 1.25), ("twisting_block", 1.45)])
def test_the_fitted_box_is_not_much_larger_than_what_is_in_it(name: str, most: float) -> None:
    """Below the scenes a cone is seen by no camera: all look from above."""
    box, truth = fit_box(SyntheticData(make_scene(name), 64, num_train=40).frames("train")), extent(name)
    assert float((box[1] - box[0]).max()) < most * float((truth[1] - truth[0]).max())


def test_one_sided_cameras_give_a_box_that_is_too_deep_rather_than_too_shallow() -> None:
    poses = torch.stack([look_at((4 * math.cos(a), 4 * math.sin(a), 0.5)) for a in torch.linspace(-0.4, 0.4, 20)])
    frames = render_frames(make_scene("static"), poses, torch.linspace(0, 1, 20), 32)
    (low, high), truth = fit_box(frames), extent("static")
    assert (low <= truth[0]).all()
    assert (high >= truth[1]).all()
    assert float(high[0] - low[0]) > 1.2 * float(high[1] - low[1])


def test_the_fitted_box_grows_with_the_scenes_units_and_a_far_plane_too_far_costs_little() -> None:
    frames = SyntheticData(make_scene("merging_balls"), 32, num_train=12).frames("train")
    poses = frames.poses.clone()
    poses[:, :3, 3] *= 64
    large = replace(frames, poses=poses, near=64 * frames.near, far=64 * frames.far)
    torch.testing.assert_close(fit_box(large), 64 * fit_box(frames))
    frames = SyntheticData(make_scene("static"), 48, num_train=30).frames("train")
    sides = [(box[1] - box[0]).max() for box in (fit_box(frames), fit_box(replace(frames, near=0.0, far=1000.0)))]
    assert sides[1] < 1.3 * sides[0]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 11), st.sampled_from([0, 3, 6]), st.sampled_from([0, 3, 6]))
def test_no_opaque_pixel_looks_past_the_fitted_box(index: int, row: int, column: int) -> None:
    frames = with_opaque(index, row, column)
    rays = frames.camera(index).rays(0.0, torch.tensor([8 * row + column]))
    for box in (fit_box(frames), hold_opaque(frames, torch.tensor([[-0.1] * 3, [0.1] * 3]))):
        enter, leave = ray_box(rays.origins, rays.directions, box)
        assert (enter.maximum(rays.near) <= leave.minimum(rays.far) + 1e-4).all()


def test_images_that_show_nothing_give_what_cameras_see_those_that_show_something_everywhere_what_a_tenth_see() -> None:
    clear, side = fit_box(views(channels=4)), seen_box(views(), 0.0)
    assert (clear[0] < side[0]).all()
    assert (clear[1] > side[1]).all()
    plain = views(40)
    patterned = replace(plain, images=torch.randint(0, 256, plain.images.shape, dtype=torch.uint8))
    torch.testing.assert_close(fit_box(views()), clear)
    torch.testing.assert_close(fit_box(patterned), seen_box(plain, 0.1))
    opaque = replace(plain, images=torch.nn.functional.pad(plain.images, (0, 1), value=255))
    torch.testing.assert_close(fit_box(opaque), fit_box(plain))


@pytest.mark.parametrize("color", [(1.0, 1.0, 1.0), (0.4, 0.4, 0.4)])
def test_opaque_images_before_one_colour_give_the_box_that_alpha_gives(color: tuple[float, float, float]) -> None:
    """Within a pixel: where a body has the colour behind it, nothing tells it from that."""
    poses, times = random_views(30)
    clear = render_frames(make_scene("static"), poses, times, 64)
    plain = render_frames(make_scene("static"), poses, times, 64, background=color)
    for frames in (plain, replace(plain, background=None)):
        torch.testing.assert_close(fit_box(frames), fit_box(clear), rtol=0, atol=4 * 0.72 / 64)


def test_sparse_points_give_their_box_with_room_and_without_the_wrong_ones() -> None:
    points = torch.rand(10_000, 3) * torch.tensor([2.0, 1.0, 1.0])
    points[::200] = 1e3
    points[1] = math.nan
    box = fit_box(views(), points)
    expected = torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 1.0]]) + 0.3 * torch.tensor([[-1.0], [1.0]])
    torch.testing.assert_close(box, expected, rtol=0, atol=0.05)  # a hundredth at either end is left out
    with pytest.raises(ValueError, match="points must hold a finite one"):
        fit_box(views(), torch.full((3, 3), math.nan))
    with pytest.raises(ValueError, match="points must have shape"):
        fit_box(views(), torch.zeros(3))


def test_sparse_points_behind_the_far_plane_do_not_widen_the_box() -> None:
    near, behind = torch.rand(1000, 3), torch.rand(3000, 3) + torch.tensor([0.0, 0.0, -30.0])
    torch.testing.assert_close(fit_box(views(), torch.cat([near, behind])), fit_box(views(), near))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_the_share_of_views_is_that_of_rays_that_pass(seed: int) -> None:
    """A place on the ray of a view's pixel, between its planes, is seen by it; behind the planes it is not."""
    frames = views(1)
    generator = torch.Generator().manual_seed(seed)
    rays = frames.camera(0).rays(0.0, torch.randint(64, (1,), generator=generator))
    ends = torch.stack([rays.near, rays.far])
    inside = torch.lerp(ends[0], ends[1], torch.rand(1, generator=generator).clamp(0.001, 0.999))
    for distance, expected in ((inside, 1.0), (0.99 * ends[0], 0.0), (1.01 * ends[1], 0.0), (-inside, 0.0)):
        assert share_of_views(frames, rays.origins + distance[:, None] * rays.directions).tolist() == [expected]


def test_half_of_opposite_views_see_what_lies_behind_the_far_plane_of_the_other_half() -> None:
    poses = torch.stack([look_at((4.0, 0.0, 0.0)), look_at((-4.0, 0.0, 0.0))])
    frames = replace(views(2), poses=poses)
    # 2.5 is 1.5 in front of the first camera, nearer than its near plane at 2, and 6.5 from the other.
    places = torch.tensor([[0.0, 0.0, 0.0], [2.5, 0.0, 0.0], [0.0, 3.0, 0.0], [-1.99, 0.0, 0.0]])
    assert share_of_views(frames, places).tolist() == [1.0, 0.0, 0.0, 1.0]


def test_what_cameras_see_ends_at_the_corners_of_images_and_the_planes() -> None:
    lens = Intrinsics.from_angle(9, 9, 2 * math.atan(0.5))
    images = torch.zeros(1, 9, 9, 3, dtype=torch.uint8)
    frames = Frames(images, look_at((4.0, 0.0, 0.0))[None], torch.zeros(1), lens)
    across = 6 * 0.5 * 8 / 9  # from pixel centre to pixel centre at the far plane
    expected = torch.tensor([[-2.0, -across, -across], [2.0, across, across]])
    torch.testing.assert_close(seen_box(frames, 0), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_what_several_cameras_see_is_that_share_of_what_most_see(share: float) -> None:
    frames = views(40)
    box = seen_box(frames, share)
    ends = seen_box(frames, 0)
    positions = torch.lerp(ends[0], ends[1], torch.rand(20_000, 3))
    seen = positions[share_of_views(frames, positions) >= share]
    torch.testing.assert_close(box, torch.stack([seen.amin(0), seen.amax(0)]), rtol=0, atol=0.25)


@pytest.mark.parametrize(
    ("box", "near", "far"), [(((10, 10, 10), (11, 11, 11)), 2.0, 6.0), (((-1, -1, -1), (1, 1, 1)), 7.0, 9.0)]
)
def test_a_box_that_no_camera_sees_is_refused(box: tuple, near: float, far: float) -> None:
    frames = replace(views(), near=near, far=far)
    with pytest.raises(ValueError, match=rf"box must be seen by some camera between near {near:g} and far {far:g}"):
        check_views(frames, torch.tensor(box, dtype=torch.float32))
    check_views(views(), torch.tensor([[-1.0] * 3, [1.0] * 3]))


def occupied(half: float, center: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupiedCells:
    """Cells of a box that a body around a centre fills, 1.8 long and 0.6 thick."""
    steps = (torch.arange(32) + 0.5) / 32 * 2 * half - half
    positions = torch.cartesian_prod(steps, steps, steps).view(32, 32, 32, 3) - torch.tensor(center)
    inside = (positions.abs() < torch.tensor([0.9, 0.3, 0.3])).all(-1)
    return OccupiedCells(torch.tensor([[-half] * 3, [half] * 3]), inside)


def test_faces_that_cut_geometry_are_named_unless_few_views_see_it() -> None:
    frames = views(40)
    assert cut_faces(occupied(0.8), frames) == ["x=-0.8", "x=0.8"]
    assert cut_faces(occupied(1.1), frames) == []
    assert cut_faces(occupied(0.25), frames) == ["x=-0.25", "x=0.25", "y=-0.25", "y=0.25", "z=-0.25", "z=0.25"]
    far_off = occupied(4.0, (3.6, 0.0, 0.0))
    assert cut_faces(far_off, frames, min_views=0.5) == []
    assert cut_faces(far_off, frames, min_views=0.0) == ["x=4"]
