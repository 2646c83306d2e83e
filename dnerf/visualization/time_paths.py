"""Time paths: the time of every frame of a film."""

import math
from collections.abc import Mapping, Sequence

import torch

from dnerf.core.checks import check_choice, check_positive
from dnerf.data.normalization import Clock

TIME_PATHS = ("sweep", "pingpong", "slow")
ROUNDING = 1e-6  # of the clock, beyond either end of what there is


def film_times(
    num_frames: int,
    time: str | float,
    limits: Sequence[float] = (0.0, 1.0),
    limits_clock: Clock | None = None,
    clock: Clock | None = None,
    slow_motion: Mapping[str, float] | None = None,
) -> list[float]:
    """Times of a film in [0, 1].

    Args:
        num_frames: of the film.
        time: "sweep", "pingpong" or "slow" from the first limit to the second, or one time for all frames.
        limits: two times.
        limits_clock: of the limits; None if they are in [0, 1].
        clock: of one time, and of the slow motion's centre and width; None if they are in [0, 1].
        slow_motion: arguments of `slow_motion_times`.

    Raises:
        ValueError: for another word, or times out of range.
    """
    if not isinstance(time, str):
        return [_normalised("time", time, clock)] * num_frames
    check_choice("time", time, TIME_PATHS)
    start, end = (_normalised("time_range", value, limits_clock) for value in limits)
    if time != "slow":
        return (sweep_times if time == "sweep" else pingpong_times)(num_frames, start, end)
    slow = dict(slow_motion or {})
    if clock is not None:
        slow["center"] = _normalised("slow_motion.center", slow["center"], clock)
        slow["width"] /= clock.length
    return slow_motion_times(num_frames, start=start, end=end, **slow)


def _normalised(name: str, value: float, clock: Clock | None) -> float:
    """A time of a setting, by a clock, in [0, 1]."""
    time = float(value) if clock is None else clock.normalised(value)
    if not -ROUNDING <= time <= 1 + ROUNDING:
        low, high, by = (0, 1, "run") if clock is None else (clock.own(0.0), clock.own(1.0), "data")
        kinds = f"{', '.join(TIME_PATHS)} or a number" if name == "time" else "a number"
        raise ValueError(f"{name} must be {kinds} in [{low:.10g}, {high:.10g}] by clock={by}, got {value}")
    return min(max(time, 0.0), 1.0)


def sweep_times(num_frames: int, start: float = 0.0, end: float = 1.0) -> list[float]:
    """Times at even steps from `start` to `end` in [0, 1], both included; a single frame shows `start`."""
    _check(num_frames, start, end)
    steps = max(num_frames - 1, 1)
    return [_between(start, end, i / steps) for i in range(num_frames)]


def pingpong_times(num_frames: int, start: float = 0.0, end: float = 1.0) -> list[float]:
    """Times from `start` to `end` and back at even steps; the frame after the last would be the first again."""
    _check(num_frames, start, end)
    return [_between(start, end, 1 - abs(1 - 2 * i / num_frames)) for i in range(num_frames)]


def slow_motion_times(
    num_frames: int,
    *,
    center: float = 0.5,
    width: float = 0.4,
    factor: float = 4.0,
    start: float = 0.0,
    end: float = 1.0,
) -> list[float]:
    """A sweep that slows down smoothly around one time, monotone from `start` to `end`.

    Frames per unit of time rise from 1 to `factor` and fall again, with the profile

        p(t) = 1 + (factor - 1) cos^2(pi (t - center) / width)    within width / 2 of the centre, 1 elsewhere.

    Frames lie at even steps of its integral. Raises ValueError for numbers out of range.

    Args:
        center: the slowest time, in [0, 1].
        width: of the slow stretch of time, > 0.
        factor: how many times slower the scene runs at the centre than outside, >= 1.
    """
    _check(num_frames, start, end, center=center)
    check_positive("width", width)
    if not 1 <= factor < math.inf:
        raise ValueError(f"factor must be at least 1 and finite, got {factor}")

    def frames_until(times: torch.Tensor) -> torch.Tensor:
        within = (times - center).clamp(-width / 2, width / 2)
        window = within / 2 + width / (4 * math.pi) * torch.sin(2 * math.pi * within / width)
        return times + (factor - 1) * window

    first, last = frames_until(torch.tensor([start, end], dtype=torch.float64)).tolist()
    wanted = torch.tensor([first + (last - first) * s for s in sweep_times(num_frames)], dtype=torch.float64)
    low, high = (torch.full_like(wanted, pick(start, end)) for pick in (min, max))
    for _ in range(60):
        middle = 0.5 * (low + high)
        before = frames_until(middle) < wanted
        low, high = torch.where(before, middle, low), torch.where(before, high, middle)
    return (0.5 * (low + high)).tolist()


def _between(start: float, end: float, share: float) -> float:
    """The time at a share of the way, never beyond either end by rounding."""
    time = start + (end - start) * share
    return min(max(time, min(start, end)), max(start, end))


def _check(num_frames: int, start: float, end: float, **others: float) -> None:
    check_positive("num_frames", num_frames)
    for name, value in (("start", start), ("end", end), *others.items()):
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {value}")
