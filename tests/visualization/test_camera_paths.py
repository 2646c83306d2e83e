"""Camera paths close, rise and stay."""

import math
from collections.abc import Callable

import pytest
import torch

from dnerf.core.cameras import look_at
from dnerf.core.geometry import so3_exp
from dnerf.visualization import box_planes, fixed_path, pose_around, spiral_path


def test_orbit_closes() -> None:
    poses = spiral_path(12, radius=3.0, elevations=(0.4, 0.4), target=(1, 2, 3), turns=1, start_angle=0.3).double()
    turn = so3_exp(torch.tensor([0, 0, 2 * math.pi / 12], dtype=torch.float64))
    target = torch.tensor([1, 2, 3], dtype=torch.float64)
    for this, following in zip(poses, poses.roll(-1, 0)):
        torch.testing.assert_close(turn @ this[:3, :3], following[:3, :3], rtol=0, atol=1e-6)
        torch.testing.assert_close(turn @ (this[:3, 3] - target), following[:3, 3] - target, rtol=0, atol=1e-6)
    offsets = poses[:, :3, 3] - target
    torch.testing.assert_close(offsets.norm(dim=-1), torch.full((12,), 3.0, dtype=torch.float64), rtol=1e-6, atol=0)
    torch.testing.assert_close(
        offsets[:, 2] / 3, torch.full((12,), math.sin(0.4), dtype=torch.float64), rtol=0, atol=1e-6
    )


def test_spiral_rises_and_returns_and_a_fixed_path_stays() -> None:
    poses = spiral_path(40, radius=2.0, elevations=(0.1, 1.0), turns=2)
    heights = torch.arcsin(poses[:, 2, 3] / 2)
    assert heights[0].item() == pytest.approx(0.1, abs=1e-6)
    assert heights[20].item() == pytest.approx(1.0, abs=1e-6)
    assert (heights[:20].diff() > 0).all()
    assert (heights[20:].diff() < 0).all()
    angles = torch.atan2(poses[:, 1, 3], poses[:, 0, 3])
    steps = torch.remainder(angles.diff(), 2 * math.pi)
    torch.testing.assert_close(steps, torch.full_like(steps, 4 * math.pi / 40), rtol=0, atol=1e-5)
    pose = look_at((1, 2, 3))
    assert torch.equal(fixed_path(4, pose), pose.repeat(4, 1, 1))


def test_a_pose_around_a_target_is_where_its_angles_say() -> None:
    pose = pose_around((1.0, 2.0, 3.0), radius=2.0, azimuth=math.pi / 2, elevation=math.pi / 6)
    torch.testing.assert_close(pose, look_at((1.0, 2.0 + math.sqrt(3), 4.0), (1.0, 2.0, 3.0)))


def test_planes_of_an_axis_aligned_view_are_the_boxes_faces() -> None:
    box = [[-1.0, -2.0, -3.0], [0.5, 2.0, 3.0]]
    poses = torch.stack([look_at((x, 0.0, 0.0), (x - 1, 0.0, 0.0)) for x in (4.0, 0.0, -2.0)])
    # The last camera looks away from the box: nothing is between its planes, which is no error.
    expected = [3.5, 5.0, 0.0, 1.0, 0.0, 1e-3]
    assert [plane for planes in box_planes(poses, box) for plane in planes] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: spiral_path(0), "num_poses must be > 0"),
        (lambda: spiral_path(4, radius=0.0), "radius must be > 0"),
        (lambda: fixed_path(0, torch.eye(4)), "num_poses must be > 0"),
        (lambda: fixed_path(3, torch.eye(3)), "pose must have shape"),
        (lambda: box_planes(torch.eye(4), [[0.0] * 3, [1.0] * 3]), "poses must have shape"),
    ],
)
def test_bad_paths_are_refused(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
