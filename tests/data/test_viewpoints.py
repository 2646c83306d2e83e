"""Cameras say by themselves which way is up, what they look at and what they cannot tell."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics, look_at
from dnerf.core.geometry import so3_exp
from dnerf.data.synthetic import random_views
from dnerf.data.viewpoints import (
    Viewpoints,
    choose_up,
    common_focus,
    measured_up,
    planes_of,
    reach_around,
    unknown_parts,
)

LENS = Intrinsics.from_angle(40, 30, 0.7)
TURN = so3_exp(torch.tensor([1.1, -0.4, 0.3], dtype=torch.float64))


def around(count: int = 20) -> Tensor:
    return random_views(count)[0].double()


def moved(
    poses: Tensor, turn: Tensor = TURN, scale: float = 50.0, shift: tuple[float, ...] = (9.0, -4.0, 7.0)
) -> Tensor:
    result = poses.clone()
    result[:, :3, :3] = turn @ poses[:, :3, :3]
    result[:, :3, 3] = scale * (poses[:, :3, 3] @ turn.T) + torch.tensor(shift, dtype=torch.float64)
    return result


def views(poses: Tensor) -> Viewpoints:
    return Viewpoints.of(poses, [LENS] * len(poses))


def test_level_cameras_show_which_way_is_up() -> None:
    up, is_level = measured_up(views(moved(around())))
    assert is_level
    torch.testing.assert_close(up, TURN[:, 2], rtol=0, atol=1e-6)


def test_a_format_s_up_stays_unless_level_cameras_are_held_otherwise() -> None:
    z = (0.0, 0.0, 1.0)
    assert choose_up(views(around()), z) == (z, "as the format says")
    assert choose_up(views(around()), None)[0] == z
    y_up = moved(around(), torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double(), 1.0, (0.0, 0.0, 0.0))
    assert choose_up(views(y_up), z) == ((0.0, 1.0, 0.0), "as the cameras are held")
    # One camera that looks down by 60 degrees says little.
    steep = look_at((0.0, -1.0, math.sqrt(3)))[None].double().expand(5, 4, 4)
    assert choose_up(views(steep), z) == (z, "as the format says")


def test_the_focus_is_where_view_axes_meet_in_any_units() -> None:
    focus = common_focus(views(moved(around())))
    torch.testing.assert_close(focus, torch.tensor([9.0, -4.0, 7.0]).double(), rtol=0, atol=1e-3)


def test_a_few_cameras_that_look_elsewhere_do_not_move_the_focus() -> None:
    poses = around(40)
    poses[::10] = torch.stack([look_at((4.0, 0.0, 1.0), (0.0, float(i), 3.0)) for i in range(2, 6)]).double()
    assert float(common_focus(views(poses)).norm()) < 0.05


def test_planes_are_around_what_cameras_look_at() -> None:
    near, far, by = planes_of(views(moved(around())), None)
    assert (near, far) == pytest.approx((100, 300), rel=1e-2)
    assert by == "from what the cameras look at"


def test_planes_follow_sparse_points() -> None:
    near, far, by = planes_of(views(moved(around())), 5 * torch.randn(400, 3) + torch.tensor([9.0, -4.0, 7.0]))
    assert 140 < near < 160
    assert 240 < far < 270
    assert by == "from sparse points"


def test_cameras_side_by_side_or_looking_outwards_have_no_focus() -> None:
    rows = torch.stack([look_at((float(x), -4.0, 0.0), (float(x), 0.0, 0.0)) for x in range(5)]).double()
    outwards = torch.stack(
        [look_at((math.cos(a), math.sin(a), 0), (9 * math.cos(a), 9 * math.sin(a), 0)) for a in range(6)]
    )
    for poses in (rows, outwards.double()):
        assert common_focus(views(poses)) is None
        assert "guessed" in planes_of(views(poses), None)[2]


def test_cameras_that_go_around_something_reach_half_as_far_again_in_any_units() -> None:
    for poses in (moved(around()), moved(arc(20, 120))):
        own = views(poses)
        assert reach_around(own, common_focus(own)) == pytest.approx(1.5 * 50 * 4, rel=0.05)


def test_cameras_on_one_side_reach_as_far_as_anything_lies() -> None:
    """Their axes cross at a small angle: a little noise moves the focus much."""
    own = views(arc(20, 20))
    assert reach_around(own, common_focus(own)) == math.inf


def test_an_off_centre_crop_is_looked_at_within_its_image() -> None:
    crop = Intrinsics(40, 30, 55.0, 55.0, center_x=-60.0, center_y=15.0)
    forward = Viewpoints.of(torch.eye(4)[None], [crop]).forward[0]
    assert float(forward[0] / -forward[2]) == pytest.approx(60 / 55)


def arc(count: int, degrees: float) -> Tensor:
    angles = torch.linspace(0, math.radians(degrees), count).tolist()
    return torch.stack([look_at((4 * math.cos(a), 4 * math.sin(a), 1.0)) for a in angles]).double()


@pytest.mark.parametrize(("poses", "said"), [
    (around(1), "one training image"),
    (around(1).expand(12, 4, 4), "one camera that stands still"),
    (arc(2, 30).repeat(6, 1, 1), "two viewpoints"),
    (arc(4, 60).repeat(6, 1, 1), "4 viewpoints on one side"),
    (arc(4, 270).repeat(6, 1, 1), None),
    (arc(30, 60), None),
    (around(), None),
])  # fmt: skip
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_what_cannot_be_determined_is_said_in_any_units(poses, said, scale) -> None:
    own = views(moved(poses, scale=scale, shift=(0.0, 0.0, 0.0)))
    told = unknown_parts(own, common_focus(own))
    assert (told is None) == (said is None)
    assert said is None or said in told


def test_cameras_side_by_side_far_from_the_origin_are_no_single_camera() -> None:
    rows = torch.stack([look_at((float(x), -4.0, 0.0), (float(x), 0.0, 0.0)) for x in range(9)]).double()
    away = moved(rows, torch.eye(3).double(), 1.0, (4e5, 5e6, 100.0))
    own = views(away)
    assert unknown_parts(own, common_focus(own)) is None
    near, far, by = planes_of(own, None)
    assert (near, far) == pytest.approx((2.0, 40.0))
    assert "guessed" in by
