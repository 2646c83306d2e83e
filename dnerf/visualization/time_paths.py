"""Time paths: the time of every frame of a film."""

import math

import torch

from dnerf.core.checks import check_positive


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
