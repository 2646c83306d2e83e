from collections.abc import Callable

import pytest

from dnerf.data.normalization import Clock
from dnerf.visualization import film_times, pingpong_times, sweep_times


def test_a_sweep_has_even_steps_and_both_ends_and_a_pingpong_closes() -> None:
    assert sweep_times(5) == [0, 0.25, 0.5, 0.75, 1]
    assert sweep_times(3, 0.8, 0.2) == pytest.approx([0.8, 0.5, 0.2])
    assert sweep_times(1, 0.3, 0.9) == [0.3]
    times = pingpong_times(6)
    assert times == pytest.approx([0, 1 / 3, 2 / 3, 1, 2 / 3, 1 / 3])
    steps = [abs(b - a) for a, b in zip(times, [*times[1:], times[0]])]
    assert steps == pytest.approx([1 / 3] * 6)


@pytest.mark.parametrize("path", [sweep_times, pingpong_times])
def test_rounding_never_leaves_the_range(path: Callable[..., list[float]]) -> None:
    for end in (0.4, 0.3, 1.0, 0.1):
        for count in (25, 49, 60, 100):
            assert all(0 <= time <= end for time in path(count, start=end, end=0.0))
            assert all(0 <= time <= end for time in path(count, start=0.0, end=end))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"num_frames": 0}, "num_frames"),
        ({"num_frames": 3, "start": -0.1}, "start"),
        ({"num_frames": 3, "end": 1.5}, "end"),
    ],
)
def test_numbers_out_of_range_are_named(arguments: dict, named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named} must be"):
        pingpong_times(**arguments)


def test_times_of_a_film_follow_a_clock_and_are_refused_beyond_it() -> None:
    clock = Clock(10.0, 20.0)
    assert film_times(3, 25.0, clock=clock) == [0.75] * 3
    assert film_times(3, "sweep", (15.0, 20.0), clock) == pytest.approx([0.25, 0.375, 0.5])
    assert film_times(2, "pingpong", (0.2, 0.6)) == pytest.approx([0.2, 0.6])
    with pytest.raises(
        ValueError, match=r"time must be sweep, pingpong or a number in \[10, 30\] by clock=data, got 31"
    ):
        film_times(3, 31.0, clock=clock)
    with pytest.raises(ValueError, match=r"time_range must be a number in \[0, 1\] by clock=run"):
        film_times(3, "sweep", (0.0, 1.5))
