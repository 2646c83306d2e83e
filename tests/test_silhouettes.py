"""When matter is most spread out, told from silhouettes."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dnerf.cameras import Intrinsics, look_at
from dnerf.data.frames import Frames
from dnerf.silhouettes import LEAST_FRAMES, most_shown_time, silhouette_areas
from dnerf.time_window import MIDDLE, TimeWindow

SIZE = 48
BALL = 0.3


def directions(count: int, seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=-1)


def two_balls(gaps: Tensor, times: Tensor, seed: int = 0, distance: float = 4.0) -> Frames:
    """Pictures of two balls on the x axis whose centres are so far apart, each from a random place."""
    count = len(times)
    intrinsics = Intrinsics.from_angle(SIZE, SIZE, 0.6)
    g = torch.Generator().manual_seed(seed)
    far = distance * (1 + 0.3 * torch.rand(count, generator=g))  # nearer cameras show more, which must not count
    poses = torch.stack([look_at((d * r).tolist()) for d, r in zip(directions(count, seed), far, strict=True)])
    frames = Frames(torch.zeros(count, SIZE, SIZE, 4, dtype=torch.uint8), poses, times, intrinsics, 1.0, 8.0)
    for i in range(count):
        rays = frames.camera(i).rays(float(times[i]))
        seen = torch.zeros(SIZE * SIZE, dtype=torch.bool)
        for side in (-0.5, 0.5):
            to_center = torch.tensor([side * float(gaps[i]), 0.0, 0.0]) - rays.origins
            along = (to_center * rays.directions).sum(-1, keepdim=True)
            seen |= (to_center - along * rays.directions).norm(dim=-1) < BALL
        frames.images[i, ..., 3] = 255 * seen.view(SIZE, SIZE)
    return frames


def apart_except_at(when: float, times: Tensor) -> Tensor:
    return 1.2 * (1 - torch.exp(-((times - when) ** 2) / 0.02))


def test_areas_are_those_of_the_average_view() -> None:
    """Of two balls: twice that of one where they are apart (less what they hide), that of one where they are one."""
    times = torch.linspace(0, 1, 120)
    found = silhouette_areas(two_balls(apart_except_at(0.5, times), times))
    assert found is not None
    assert float(found.times[found.areas.argmin()]) == pytest.approx(0.5, abs=0.03)
    assert 1.6 < float(found.areas.max() / found.areas.min()) < 2.1
    assert float(found.errors[found.areas.argmax()]) == 0
    assert float(found.errors[50]) < 0.1


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("when", [0.5, 0.45, 0.6])
def test_what_comes_together_in_the_middle_moves_the_origin(when: float, seed: int) -> None:
    times = torch.linspace(0, 1, 100)
    time = most_shown_time(two_balls(apart_except_at(when, times), times, seed))
    assert float(apart_except_at(when, torch.tensor(time))) > 0.6  # the balls do not touch any more
    assert abs(time - MIDDLE) < 0.35  # and the time is not further away than it must be


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_keeps_its_shape_stays_in_the_middle(seed: int) -> None:
    times = torch.rand(60, generator=torch.Generator().manual_seed(seed))
    times[:2] = torch.tensor([0.0, 1.0])
    assert most_shown_time(two_balls(torch.full((60,), 0.9), times, seed)) == MIDDLE


def test_what_views_explain_is_no_change_with_time() -> None:
    """A plate covers as much as the cosine at which it is seen."""
    times = torch.linspace(0, 1, 100)
    frames = two_balls(torch.zeros(100), times)
    eyes = frames.poses[:, :3, 3]
    cosines = eyes[:, 2].abs() / eyes.norm(dim=-1) * (4 / eyes.norm(dim=-1)) ** 2
    frames.images[..., 3] = (255 * cosines)[:, None, None].to(torch.uint8)
    found = silhouette_areas(frames)
    assert found is not None
    assert float(found.areas.max() - found.areas.min()) < 0.1
    assert float(found.errors.max()) < 0.05


def test_frames_that_tell_nothing_stay_in_the_middle() -> None:
    times = torch.linspace(0, 1, 60)
    frames = two_balls(apart_except_at(0.5, times), times)
    assert most_shown_time(frames) != MIDDLE
    assert most_shown_time(frames.subset(range(LEAST_FRAMES - 1))) == MIDDLE
    assert most_shown_time(replace(frames, images=frames.images[..., :3].contiguous())) == MIDDLE
    assert most_shown_time(replace(frames, times=torch.full_like(times, 0.3))) == MIDDLE
    assert most_shown_time(replace(frames, images=torch.zeros_like(frames.images))) == MIDDLE


def test_cameras_in_a_row_and_of_one_place_are_no_trouble() -> None:
    times = torch.linspace(0, 1, 60)
    frames = two_balls(apart_except_at(0.5, times), times)
    row = look_at((0.0, -4.0, 0.0)).repeat(60, 1, 1)
    for poses in (row, row.clone().index_put_((torch.arange(60), torch.tensor(0), torch.tensor(3)), times)):
        assert 0 <= most_shown_time(replace(frames, poses=poses)) <= 1


def test_only_times_of_the_frames_are_told() -> None:
    times = torch.linspace(0.6, 0.9, 60)
    assert 0.6 <= most_shown_time(two_balls(apart_except_at(0.6, times), times)) <= 0.9
    still = most_shown_time(two_balls(torch.full((60,), 0.9), times))
    assert still == pytest.approx(0.6, abs=1e-6)  # the nearest to the middle


def test_a_window_opens_around_it_unless_told_otherwise() -> None:
    times = torch.linspace(0, 1, 11)
    window = TimeWindow(None, start=0.05)
    assert times[window.frames_in(times, 0.0)].tolist() == [0.5]
    window.open_around(0.2)
    assert times[window.frames_in(times, 0.0)].tolist() == pytest.approx([0.2])
    given = TimeWindow(0.7, start=0.05)
    given.open_around(0.2)
    assert times[given.frames_in(times, 0.0)].tolist() == pytest.approx([0.7])
    assert math.isclose(given.origin, 0.7)
