"""Frames are divided and timed as the files say, and what is decided instead is said."""

from pathlib import Path

import pytest
import torch

from dnerf.core.cameras import Intrinsics
from dnerf.data.capture import Capture, CaptureFrame, ImageFile
from dnerf.data.normalization import Clock
from dnerf.data.splits import split_frames

POSE = tuple(map(tuple, torch.eye(4).tolist()))
LENS = Intrinsics.from_angle(8, 8, 0.7)


def frames(times: list[float | None], prefix: str = "r", image: bool = True) -> tuple[CaptureFrame, ...]:
    file = ImageFile(Path("x.png")) if image else None
    return tuple(CaptureFrame(f"{prefix}_{i}", POSE, LENS, file, None, time) for i, time in enumerate(times))


def capture(**splits: tuple[CaptureFrame, ...]) -> Capture:
    return Capture(Path("data"), "transforms", splits)


def test_every_eighth_frame_is_held_out_and_named() -> None:
    made = split_frames(capture(all=frames([i / 19 for i in range(20)])))
    assert [frame.name for frame in made.splits["test"]] == ["r_4", "r_12"]
    assert len(made.splits["train"]) == 18
    assert any("2 frames (r_4, r_12) held out" in note for note in made.notes)
    assert "test" not in split_frames(capture(all=frames([0.0, 1.0])), None).splits
    assert "test" not in split_frames(capture(all=frames([0.5]))).splits


def test_a_train_split_alone_is_divided_and_given_splits_stay() -> None:
    assert len(split_frames(capture(train=frames([0.0] * 12))).splits["test"]) == 1
    given = split_frames(capture(train=frames([0.0, 1.0]), test=frames([0.5], image=False)))
    assert len(given.splits["train"]) == 2
    assert given.splits["test"][0].image is None
    judged = split_frames(capture(train=frames([0.0, 1.0]), val=frames([0.5])))
    assert judged.splits["test"] == judged.splits["val"]


def test_times_of_any_clock_go_from_0_to_1() -> None:
    made = split_frames(capture(train=frames([100.0, 103.0, 110.0]), test=frames([105.0])))
    assert [frame.time for frame in made.splits["train"]] == pytest.approx([0, 0.3, 1])
    assert made.splits["test"][0].time == pytest.approx(0.5)
    assert made.clock == Clock(100.0, 10.0)
    assert any("times 100 to 110" in note for note in made.notes)


def test_times_within_0_and_1_are_kept_exactly() -> None:
    made = split_frames(capture(train=frames([0.1, 0.30000001, 0.7])))
    assert [frame.time for frame in made.splits["train"]] == [0.1, 0.30000001, 0.7]
    assert made.clock == Clock()


def test_frames_without_times_are_static_or_numbered_as_asked() -> None:
    without = capture(train=frames([None] * 5), test=frames([None] * 2))
    made = split_frames(without)
    assert {frame.time for frame in made.splits["train"]} == {0.0}
    assert any("data.times=order" in note for note in made.notes)
    numbered = split_frames(without, times="order")
    assert [frame.time for frame in numbered.splits["train"]] == [0, 0.25, 0.5, 0.75, 1]
    assert [frame.time for frame in numbered.splits["test"]] == [0, 1]
    still = split_frames(capture(train=frames([3.0, 4.0])), times="static")
    assert {frame.time for frame in still.splits["train"]} == {0.0}
    assert any("one time" in note for note in split_frames(capture(train=frames([7.0] * 3))).notes)


@pytest.mark.parametrize(("given", "message"), [
    (capture(train=frames([0.0, None])), "frame r_1 has none; set data.times=order or data.times=static"),
    (capture(train=frames([0.0, 1.0], image=False)), "there must be training frames with images"),
    (capture(test=frames([0.0])), "there must be training frames with images"),
])  # fmt: skip
def test_what_cannot_be_divided_or_timed_is_refused(given, message) -> None:
    with pytest.raises(ValueError, match=message):
        split_frames(given)
