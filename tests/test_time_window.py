"""The window that lets frames in by time."""

import pytest
import torch
from torch import Tensor

from dnerf.time_window import TimeWindow

SIZE = 6  # pixels of a frame


def draw(window: TimeWindow, times: list[float], progress: float, count: int = 2000) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return window.draw(torch.tensor(times), SIZE * len(times), count, progress, generator=generator)


def seen(window: TimeWindow, times: list[float], progress: float) -> set[float]:
    return {times[i] for i in (draw(window, times, progress) // SIZE).tolist()}


def test_the_window_opens_from_the_origin_outwards() -> None:
    times = [0.9, 0.1, 0.5, 0.3, 0.7]
    window = TimeWindow(0.4, end=0.5, start=0.4)
    assert seen(window, times, 0.0) == {0.5, 0.3}
    # Half way there, 0.7 of five frames: 3.5 rounds to the even 4; 0.1 and 0.7 are next.
    assert seen(window, times, 0.25) == {0.5, 0.3, 0.1, 0.7}
    assert seen(window, times, 0.5) == {0.5, 0.3, 0.1, 0.7, 0.9}


def test_the_window_says_which_frames_are_in() -> None:
    times = torch.tensor([0.9, 0.1, 0.5, 0.3, 0.7])
    window = TimeWindow(0.4, end=0.5, start=0.4)
    chosen = window.frames_in(times, 0.0)
    assert chosen is not None
    assert sorted(chosen.tolist()) == [2, 3]
    assert window.frames_in(times, 0.5) is None


def test_every_pixel_of_the_frames_that_are_in_is_drawn() -> None:
    indices = draw(TimeWindow(1.0, start=0.5), [0.0, 1.0], 0.0)
    assert sorted(set(indices.tolist())) == list(range(6, 12))


def test_an_open_window_changes_nothing() -> None:
    drawn = draw(TimeWindow(0.5, end=0.6), [0.0, 0.5, 1.0], 0.6, count=50)
    assert torch.equal(drawn, torch.randint(3 * SIZE, (50,), generator=torch.Generator().manual_seed(0)))


def test_frames_of_one_time_come_in_together() -> None:
    assert seen(TimeWindow(0.5, start=0.1), [0.3] * 10, 0.0) == {0.3}
    assert TimeWindow(0.5, start=0.1).frames_in(torch.full((10,), 0.3), 0.0) is None  # all of them
    assert len(set((draw(TimeWindow(0.5, start=0.1), [0.3] * 10, 0.0) // SIZE).tolist())) == 10
    both_sides = draw(TimeWindow(0.5, start=0.4), [0.0, 0.4, 0.5, 0.6, 1.0], 0.0) // SIZE
    assert set(both_sides.tolist()) == {1, 2, 3}


def test_a_window_serves_other_frames_too() -> None:
    window = TimeWindow(0.0, start=0.5)
    assert seen(window, [0.0, 1.0], 0.0) == {0.0}
    assert seen(window, [0.9, 0.2], 0.0) == {0.2}


def test_what_is_over_counts_from_when_all_frames_are_in() -> None:
    window = TimeWindow(end=0.6)
    assert [window.since_open(progress) for progress in (0.0, 0.6, 1.0)] == [0.0, 0.0, 1.0]
    assert window.since_open(0.8) == pytest.approx(0.5)
    assert TimeWindow(end=1.0).since_open(1.0) == 0.0


def test_steps_count_from_when_all_frames_are_in() -> None:
    window = TimeWindow(end=0.6)
    assert window.steps_since_open(59, 0.59) is None
    assert window.steps_since_open(60, 0.6) == 0.0
    assert window.steps_since_open(90, 0.9) == pytest.approx(30.0)


def test_one_frame_is_always_in() -> None:
    assert TimeWindow(start=0.01).num_frames(3, 0.0) == 1
    assert TimeWindow(start=0.01).num_frames(3, 1.0) == 3
    assert seen(TimeWindow(0.2), [0.0, 1.0], 0.0) == {0.0}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"origin": 1.5}, r"origin must be in \[0, 1\] or None, got 1.5"),
        ({"end": 0.0}, "end must be"),
        ({"start": 2.0}, r"start must be in \(0, 1\], got 2.0"),
    ],
)
def test_bad_settings_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TimeWindow(**arguments)
