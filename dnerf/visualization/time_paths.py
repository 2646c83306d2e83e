"""Time paths: the time of every frame of a film."""

from collections.abc import Sequence

from dnerf.core.checks import check_choice, check_positive
from dnerf.data.normalization import Clock

TIME_PATHS = ("sweep", "pingpong")
ROUNDING = 1e-6  # of the clock, beyond either end of what there is


def film_times(
    num_frames: int, time: str | float, limits: Sequence[float] = (0.0, 1.0), limits_clock: Clock | None = None,
    clock: Clock | None = None,
) -> list[float]:  # fmt: skip
    """Times of a film in [0, 1].

    Args:
        num_frames: of the film.
        time: "sweep" or "pingpong" from the first limit to the second, or one time for all frames.
        limits: two times.
        limits_clock: of the limits; None if they are in [0, 1].
        clock: of one time; None if it is in [0, 1].

    Raises:
        ValueError: for another word, or times out of range.
    """
    if not isinstance(time, str):
        return [_normalised("time", time, clock)] * num_frames
    check_choice("time", time, TIME_PATHS)
    start, end = (_normalised("time_range", value, limits_clock) for value in limits)
    return (sweep_times if time == "sweep" else pingpong_times)(num_frames, start, end)


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


def _between(start: float, end: float, share: float) -> float:
    """The time at a share of the way, never beyond either end by rounding."""
    time = start + (end - start) * share
    return min(max(time, min(start, end)), max(start, end))


def _check(num_frames: int, start: float, end: float) -> None:
    check_positive("num_frames", num_frames)
    for name, value in (("start", start), ("end", end)):
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {value}")
