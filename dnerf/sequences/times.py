"""Time paths: which moment of the scene each frame of a sequence shows."""

import math

import torch

from dnerf.checks import check_positive


def sweep_times(num_frames: int, start: float = 0.0, end: float = 1.0) -> list[float]:
    """Times at even steps from `start` to `end`, both included; a single frame shows `start`.

    Raises:
        ValueError: if the number is not positive or a time lies outside [0, 1].
    """
    _check(num_frames, start, end)
    steps = max(num_frames - 1, 1)
    return [start + (end - start) * i / steps for i in range(num_frames)]


def pingpong_times(num_frames: int, start: float = 0.0, end: float = 1.0) -> list[float]:
    """Times from `start` to `end` and back at even steps; the frame after the last would be the first again.

    Raises:
        ValueError: if the number is not positive or a time lies outside [0, 1].
    """
    _check(num_frames, start, end)
    return [start + (end - start) * (1 - abs(1 - 2 * i / num_frames)) for i in range(num_frames)]


def slow_motion_times(
    num_frames: int,
    *,
    center: float = 0.5,
    width: float = 0.4,
    factor: float = 4.0,
    start: float = 0.0,
    end: float = 1.0,
) -> list[float]:
    """A sweep that slows down smoothly around one moment.

    Frames per unit of time rise from 1 to `factor` and fall again, with the profile

        p(t) = 1 + (factor - 1) cos^2(pi (t - center) / width)    within width / 2 of the centre, 1 elsewhere.

    Frames lie at even steps of its integral.

    Args:
        num_frames: F.
        center: the moment shown slowest, in [0, 1].
        width: of the slow stretch of time, > 0.
        factor: how many times slower the scene runs at the centre than outside, >= 1.
        start: time of the first frame.
        end: time of the last.

    Returns:
        F times between start and end, monotone.

    Raises:
        ValueError: for numbers out of range.
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
    low = torch.full_like(wanted, min(start, end))
    high = torch.full_like(wanted, max(start, end))
    for _ in range(60):
        middle = 0.5 * (low + high)
        before = frames_until(middle) < wanted
        low, high = torch.where(before, middle, low), torch.where(before, high, middle)
    return (0.5 * (low + high)).tolist()


def _check(num_frames: int, start: float, end: float, **others: float) -> None:
    check_positive("num_frames", num_frames)
    for name, value in (("start", start), ("end", end), *others.items()):
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {value}")
