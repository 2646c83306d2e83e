"""The world and back: similarities invert, keep angles, and leave what they need not change bit for bit."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dnerf.core.cameras import look_at
from dnerf.data.frames import is_rigid
from dnerf.data.normalization import IDENTITY, LONGEST_SIDE, Clock, Similarity, upright

UPS = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.3, -2.0, 0.7)]


def similarity(up: tuple[float, float, float] = (0.3, -2.0, 0.7)) -> Similarity:
    return Similarity(0.02, upright(up), (12.0, -7.0, 3e6))


@pytest.mark.parametrize("up", UPS)
def test_up_becomes_z_by_a_proper_rotation(up) -> None:
    turn = torch.tensor(upright(up), dtype=torch.float64)
    direction = torch.tensor(up, dtype=torch.float64)
    torch.testing.assert_close(turn @ (direction / direction.norm()), torch.tensor([0.0, 0, 1]).double())
    torch.testing.assert_close(turn @ turn.T, torch.eye(3).double())
    assert float(torch.linalg.det(turn)) == pytest.approx(1)


def test_the_least_rotation_leaves_what_is_across_it() -> None:
    axis = torch.linalg.cross(torch.tensor([0.3, -2.0, 0.7]).double(), torch.tensor([0.0, 0, 1]).double())
    torch.testing.assert_close(torch.tensor(upright((0.3, -2.0, 0.7))).double() @ axis, axis)


@pytest.mark.parametrize("up", UPS)
def test_what_goes_to_the_world_comes_back(up) -> None:
    there = similarity(up)
    positions = 1e3 * torch.randn(7, 3, dtype=torch.float64)
    torch.testing.assert_close(there.positions_from_world(there.positions_to_world(positions)), positions)
    poses = torch.stack([look_at((3.0, 1.0, 2.0)), look_at((-1.0, 5.0, 0.5), (1.0, 1.0, 1.0))]).double()
    assert is_rigid(there.poses_to_world(poses)).all()
    torch.testing.assert_close(there.poses_from_world(there.poses_to_world(poses)), poses, rtol=1e-9, atol=1e-8)


def test_a_camera_sees_the_same_from_its_place_in_the_world() -> None:
    there, pose = similarity(), look_at((3.0, 1.0, 2.0)).double()
    points = torch.randn(9, 3, dtype=torch.float64)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    moved = there.poses_to_world(pose)
    torch.testing.assert_close(
        (there.positions_to_world(points) - moved[:3, 3]) @ moved[:3, :3], 0.02 * local, rtol=1e-6, atol=1e-8
    )


def test_a_box_stands_at_the_origin_with_its_longest_side() -> None:
    box = torch.tensor([[-1.0, 2, 5], [4, 3, 7]])
    for up in UPS[:5]:
        world = Similarity.of_box(box, up).box_to_world(box)
        torch.testing.assert_close(world[0], -world[1])
        assert float((world[1] - world[0]).max()) == pytest.approx(LONGEST_SIDE)
        torch.testing.assert_close(Similarity.of_box(box, up).box_from_world(world), box.double())


@pytest.mark.parametrize("power", [-10, 0, 3])
def test_a_power_of_two_without_a_shift_changes_no_bit_of_a_mantissa(power) -> None:
    half = 0.5 * LONGEST_SIDE * 2.0**power
    there = Similarity.of_box([[-half] * 3, [half] * 3])
    assert there.scale == 2.0**-power
    pose = look_at((3.0, -1.0, 2.0))
    world = there.poses_to_world(pose).float()
    assert torch.equal(world[:3, :3], pose[:3, :3])
    assert torch.equal(world[:3, 3] * 2.0**power, pose[:3, 3])
    assert (there == IDENTITY) == (power == 0)


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Similarity(0.0), "scale must be positive"),
    (lambda: Similarity(math.nan), "scale must be positive"),
    (lambda: Similarity(rotation=((1.0, 0, 0), (0, 1.0, 0), (0, 0, 2.0))), "rotation must be orthonormal"),
    (lambda: Similarity(rotation=((1.0, 0, 0), (0, 1.0, 0), (0, 0, -1.0))), "rotation must be orthonormal"),
    (lambda: Similarity(center=(math.inf, 0, 0)), "center must be three finite"),
    (lambda: Similarity.of_box([[0.0] * 3, [0.0] * 3]), "low < high"),
    (lambda: upright((0, 0, 0)), "up must be a direction"),
    (lambda: Clock(0.0, 0.0), "length positive"),
])  # fmt: skip
def test_what_is_no_similarity_or_clock_is_refused(make, message) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@given(st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=9))
def test_a_clock_maps_all_times_into_the_unit_interval_and_back(times) -> None:
    clock = Clock.of(times)
    for time in times:
        assert -1e-9 <= clock.normalised(time) <= 1 + 1e-9
        assert clock.own(clock.normalised(time)) == pytest.approx(time, abs=1e-9 * max(map(abs, times)))


def test_a_clock_keeps_times_that_are_in_the_unit_interval() -> None:
    assert Clock.of([0.2, 0.7]) == Clock()
    assert Clock.of([0, 11]).normalised(5.5) == 0.5
    assert Clock.of([7.0, 7.0]).normalised(7.0) == 0
