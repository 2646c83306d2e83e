"""When training ends and when it is looked at."""

import pytest

from dnerf.limits import Limits


def test_training_ends_with_its_steps_or_its_seconds() -> None:
    limits = Limits(10, 5.0, 4, None)
    assert [limits.is_finished(step, 0.0) for step in (9, 10)] == [False, True]
    assert [limits.is_finished(0, seconds) for seconds in (4.9, 5.0)] == [False, True]
    assert not Limits(10, None, 4, None).is_finished(9, 1e9)


def test_progress_is_the_larger_share_of_steps_and_of_seconds_left_at_the_begin() -> None:
    limits = Limits(10, 5.0, 4, None)
    assert limits.progress(2, 0.5, 0.0) == pytest.approx(0.2)
    assert limits.progress(2, 2.0, 0.0) == pytest.approx(0.4)
    assert limits.progress(0, 3.0, 1.0) == pytest.approx(0.5)
    assert limits.progress(0, 1.0, 1.0) == 0.0
    assert limits.progress(0, 6.0, 6.0) == 1.0  # nothing was left
    assert limits.progress(11, 0.0, 0.0) == 1.0
    assert Limits(10, None, 4, None).progress(5, 1e9, 0.0) == 0.5


def test_the_first_the_last_and_every_nth_step_are_looked_at_and_so_is_what_is_saved() -> None:
    limits = Limits(10, None, 4, 3)
    assert [step for step in range(1, 11) if limits.is_saved(step)] == [3, 6, 9]
    assert [step for step in range(1, 11) if limits.is_looked_at(step)] == [1, 3, 4, 6, 8, 9, 10]
    assert not any(Limits(10, None, 4, None).is_saved(step) for step in range(1, 11))


@pytest.mark.parametrize(
    ("position", "name"), [(0, "num_steps"), (1, "max_seconds"), (2, "log_every"), (3, "checkpoint_every")]
)
def test_numbers_that_are_not_positive_are_refused(position: int, name: str) -> None:
    values: list[int] = [10, 5, 4, 3]
    values[position] = 0
    with pytest.raises(ValueError, match=name):
        Limits(*values)
