"""Which frames of a capture are learnt and which are scored, and what time it is in each of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from dnerf.core.checks import check_choice
from dnerf.data.capture import Capture, CaptureFrame
from dnerf.data.normalization import Clock

TIMES = ("auto", "order", "static")
NAMED = 8  # frames that a note lists


@dataclass(frozen=True)
class SplitFrames:
    """A capture's frames by split; their times are in [0, 1]."""

    splits: Mapping[str, tuple[CaptureFrame, ...]]  # "train" among them
    clock: Clock  # from the files' times
    notes: tuple[str, ...] = ()  # what was decided, a line each


def split_frames(capture: Capture, hold_out: int | None = 8, times: str = "auto") -> SplitFrames:
    """Divide a capture into splits and map its times to [0, 1].

    Where there are neither test nor validation frames, every `hold_out`-th frame becomes the test split; None holds out
    none. Validation frames are the test split where there is no other.

    Args:
        times: "auto" takes the files' times, or where they have none, one time for all; "order" numbers each split's
            frames; "static" is one time for all.

    Raises:
        ValueError: if there is nothing to train on, or some frames have a time and others none.
    """
    check_choice("times", times, TIMES)
    splits, clock, notes = _timed(capture, times)
    splits["train"] = splits.pop("all", ()) + splits.get("train", ())
    if not any(frame.image is not None for frame in splits["train"]):
        raise ValueError(f"{capture.path}: there must be training frames with images, got splits {', '.join(splits)}")
    if "test" not in splits and "val" in splits:
        splits["test"] = splits["val"]
        notes.append("there is no test split: the validation frames are scored")
    elif "test" not in splits and hold_out is not None:
        frames = splits["train"]
        held = frames[hold_out // 2 :: hold_out]  # neither the first nor the last: times between are scored
        if held and len(held) < len(frames):
            splits["train"] = tuple(frame for i, frame in enumerate(frames) if i % hold_out != hold_out // 2)
            splits["test"] = held
            notes.append(f"there is no test split: {_listed(held)} held out (data.hold_out={hold_out})")
    return SplitFrames(splits, clock, tuple(notes))


def _timed(capture: Capture, times: str) -> tuple[dict[str, tuple[CaptureFrame, ...]], Clock, list[str]]:
    frames = [frame for split in capture.splits.values() for frame in split]
    own = [frame.time for frame in frames if frame.time is not None]
    if times == "order":
        spans = {name: max(len(split) - 1, 1) for name, split in capture.splits.items()}
        numbered = {
            name: tuple(replace(frame, time=i / spans[name]) for i, frame in enumerate(split))
            for name, split in capture.splits.items()
        }
        return numbered, Clock(0.0, float(max(spans.values()))), ["times are the order of the frames, as told"]
    if times == "static" or not own:
        still = {n: tuple(replace(frame, time=0.0) for frame in split) for n, split in capture.splits.items()}
        said = "times are left out: the scene is static, as told"
        if times == "auto":
            said = "frames have no time: the scene is taken to be static; data.times=order numbers them instead"
        return still, Clock(), [said]
    if len(own) < len(frames):
        without = next(frame.name for frame in frames if frame.time is None)
        raise ValueError(
            f"{capture.path}: time must be given for all frames or none, frame {without} has none; set "
            "data.times=order or data.times=static to go without"
        )
    clock = Clock.of(own)
    notes = []
    if clock != Clock():
        notes.append(f"times {min(own):.10g} to {max(own):.10g} of the files are 0 to 1 here")
    if min(own) == max(own) and len(own) > 1:
        notes.append("all frames have one time: the scene is static")

    def normalised(frame: CaptureFrame) -> CaptureFrame:
        assert frame.time is not None
        return replace(frame, time=min(max(clock.normalised(frame.time), 0.0), 1.0))

    return {name: tuple(map(normalised, split)) for name, split in capture.splits.items()}, clock, notes


def _listed(frames: Sequence[CaptureFrame]) -> str:
    names = ", ".join(frame.name for frame in frames[:NAMED])
    more = f" and {len(frames) - NAMED} more" if len(frames) > NAMED else ""
    return f"{len(frames)} frame{'s' * (len(frames) > 1)} ({names}{more})"
