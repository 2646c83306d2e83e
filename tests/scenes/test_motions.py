"""Motions: poses compose, invert, follow their formulas and their velocities."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.core.geometry import so3_exp
from dnerf.scenes import Bounce, Fixed, Joint, Jump, Motion, Orbit, Pulse, Slide, Spin, Vanish, Wave
from dnerf.scenes.poses import Pose, turn

SLIDING = Slide(Wave(), parent=Orbit(0.5, 2.0, 0.1, 0.3))
UPPER = Joint((0.1, 0.2, 0.3), (0.0, 1.0, 0.0), Wave(0.1, ((0.7, 1.0, 0.2),)), parent=SLIDING)
CHAIN = Joint((0.0, 0.0, -0.4), (1.0, 0.0, 0.0), Wave(0.2, ((0.4, 2.0, 0.0), (0.1, 3.0, 0.5))), parent=UPPER)
MOTIONS: list[Motion] = [
    Fixed((0.1, 0.2, 0.3)), Joint((0.1, 0.2, 0.3), (0.3, -0.2, 0.5), Wave(0.6)),
    Orbit(0.7, -1.0, 0.3, 0.4, parent=Fixed((0.1, 0.0, -0.1))), Spin(2.0, parent=Fixed((0.5, 0.0, 0.0))),
    Slide(Wave(0.1, ((0.2, 1.0, 0.0),))), Slide(Bounce(0.4, 3.0, 0.8)),
    Pulse(Wave(1.0, ((0.3, 1.0, 0.25),)), parent=Fixed((0.0, 0.3, 0.0))), CHAIN,
]  # fmt: skip

every_motion = pytest.mark.parametrize("motion", MOTIONS, ids=lambda m: type(m).__name__)


def times_and_points(count: int = 64) -> tuple[Tensor, Tensor]:
    return torch.rand(count, dtype=torch.float64), torch.randn(count, 3, dtype=torch.float64)


@every_motion
def test_local_and_world_are_inverse_and_rigid_up_to_scale(motion: Motion) -> None:
    times, points = times_and_points()
    pose = motion.pose(times)
    torch.testing.assert_close(pose.to_local(pose.to_world(points)), points, rtol=0, atol=1e-14)
    eye = torch.eye(3, dtype=torch.float64).expand(len(times), 3, 3)
    torch.testing.assert_close(pose.rotation @ pose.rotation.mT, eye, rtol=0, atol=1e-14)
    torch.testing.assert_close(pose.rotation.det(), torch.ones_like(times), rtol=0, atol=1e-14)
    distance = (pose.to_world(points) - pose.translation).norm(dim=-1)
    torch.testing.assert_close(distance, pose.scale * points.norm(dim=-1), rtol=1e-14, atol=0)


@every_motion
def test_each_time_has_its_own_pose_and_whole_cycles_close(motion: Motion) -> None:
    times, points = times_and_points(7)
    together = motion.pose(times).to_world(points)
    alone = torch.cat([motion.pose(times[i : i + 1]).to_world(points[i : i + 1]) for i in range(7)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-15)
    start, end = (motion.pose(torch.full_like(times, t)).to_world(points) for t in (0.0, 1.0))
    torch.testing.assert_close(start, end, rtol=0, atol=1e-14)


def test_what_bounces_falls_freely_and_turns_round_on_the_ground() -> None:
    bounce = Bounce(0.9, 2.0, 0.5)
    marks = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=torch.float64)
    expected = torch.tensor([0.9, 0.0, 0.9, 0.0, 0.9], dtype=torch.float64)
    torch.testing.assert_close(bounce(marks), expected, rtol=0, atol=1e-15)
    times = torch.linspace(0.0, 0.2, 5, dtype=torch.float64)
    before, here, after = (bounce(times + shift) for shift in (0.0, 0.02, 0.04))
    gravity = -8 * 0.9 * 2**2  # the second derivative of 4 h s (1 - s) with s = 2 t + 1/2
    torch.testing.assert_close((before - 2 * here + after) / 0.02**2, torch.full_like(times, gravity))
    torch.testing.assert_close(bounce(marks[1] - 1e-6), bounce(marks[1] + 1e-6))


def test_turn_is_the_exponential_of_its_axis() -> None:
    angles = torch.tensor([0.0, 1e-9, 0.3, math.pi, -5.0], dtype=torch.float64)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    torch.testing.assert_close(turn((1.2, 0.0, 1.6), angles), so3_exp(angles[:, None] * axis), rtol=0, atol=1e-15)


def test_orbit_keeps_radius_speed_and_orientation() -> None:
    times = torch.linspace(0, 1, 101, dtype=torch.float64)
    pose = Orbit(0.7, 2.0, 0.1, 0.5).pose(times)
    torch.testing.assert_close(pose.translation.norm(dim=-1), torch.full_like(times, 0.7))
    steps = pose.translation.diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(steps, torch.full_like(steps, 1.4 * math.sin(2 * math.pi * 0.01)))
    assert (pose.rotation == torch.eye(3, dtype=torch.float64)).all()


def test_joint_turns_about_its_own_point() -> None:
    pose = Joint((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), Wave(0.5 * math.pi)).pose(torch.zeros(1).double())
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    expected = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(pose.to_world(points), expected, rtol=0, atol=1e-15)


def test_poses_compose_like_functions_and_the_identity_changes_nothing() -> None:
    times, points = times_and_points()
    outer, inner = MOTIONS[6].pose(times), CHAIN.pose(times)
    nested = outer.to_world(inner.to_world(points))
    torch.testing.assert_close(outer.then(inner).to_world(points), nested, rtol=0, atol=1e-14)
    assert torch.equal(Pose.at(times).to_world(points), points)


def test_wave_is_its_formula() -> None:
    value = Wave(0.5, ((2.0, 1.0, 0.25), (1.0, 3.0, 0.0)))(torch.tensor([0.1], dtype=torch.float64))
    truth = 0.5 + 2 * math.sin(2 * math.pi * 0.35) + math.sin(2 * math.pi * 0.3)
    assert value.item() == pytest.approx(truth, abs=1e-15)


def test_jumps_stand_still_in_between_and_come_back() -> None:
    jump = Jump(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    shifts = jump.pose(torch.tensor([0.0, 0.49, 0.5, 0.99, 1.0])).translation[:, 0]
    assert shifts.tolist() == [0, 0, 1, 1, 0]


def test_jumps_and_absence_without_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="places must hold at least one"):
        Jump(())
    for gone in ((0.0, 0.5), (0.6, 0.4), (0.5, 1.0)):
        with pytest.raises(ValueError, match="gone must be two increasing times"):
            Vanish(gone)
