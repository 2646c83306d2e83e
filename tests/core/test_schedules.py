"""Schedules are closed forms of progress."""

import pytest

from dnerf.core.schedules import Fade, Ramp, at


def test_ramps_have_their_closed_forms() -> None:
    linear, exponential = Ramp(1.0, 3.0, 0.2, 0.6), Ramp(1.0, 4.0, 0.2, 0.6, kind="exponential")
    assert [linear(p) for p in (0.0, 0.2, 0.4, 0.6, 1.0)] == pytest.approx([1, 1, 2, 3, 3])
    assert [exponential(p) for p in (0.0, 0.2, 0.4, 0.6, 1.0)] == pytest.approx([1, 1, 2, 4, 4])
    assert Ramp(0.0, 1.0)(0.25) == 0.25


def test_a_fade_leaves_its_share() -> None:
    fade = Fade(2.0, 0.01, 0.5, 1.0)
    assert [fade(p) for p in (0.0, 0.5, 0.75, 1.0)] == pytest.approx([2, 2, 0.2, 0.02])


def test_numbers_are_schedules_that_stay() -> None:
    assert at(3, 0.1) == 3.0
    assert at(Ramp(1.0, 2.0), 0.5) == 1.5


@pytest.mark.parametrize(("make", "message"), [
    (lambda: Ramp(1.0, 2.0, 0.5, 0.5), "begin and end must be 0 <= begin < end <= 1, got 0.5 and 0.5"),
    (lambda: Ramp(1.0, 2.0, 0.5, 1.5), "begin and end must be 0 <= begin < end <= 1"),
    (lambda: Ramp(-1.0, 2.0), "start must be >= 0"), (lambda: Ramp(1.0, 0.0, kind="exponential"), "stop must be > 0"),
    (lambda: Ramp(1.0, 2.0, kind="cosine"), "kind must be one of linear, exponential; got 'cosine'"),
    (lambda: Fade(1.0, 0.0), r"share must be in \(0, 1\], got 0.0"),
])  # fmt: skip
def test_numbers_out_of_range_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
