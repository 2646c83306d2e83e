"""Timing and the machine's rates."""

import time

import pytest
import torch

from benchmarks.machine import Rates, describe_machine, measure_rates
from benchmarks.timing import fitted_order, num_threads, recorded, summarize, time_in_turn


def test_calls_take_turns_and_the_first_round_does_not_count():
    order = []
    calls = {name: lambda name=name: order.append(name) for name in "ab"}
    timings = time_in_turn(calls, seconds=1e-9, min_repeats=3)
    assert order == list("ab" * 4)
    assert {t.count for t in timings.values()} == {3}


def test_medians_tell_slow_from_quick():
    timings = time_in_turn({"slow": lambda: time.sleep(0.01), "quick": lambda: None}, seconds=1e-9, min_repeats=5)
    assert 0.01 <= timings["slow"].low <= timings["slow"].median <= timings["slow"].high
    assert timings["quick"].median < timings["slow"].median
    assert timings["slow"].milliseconds["median_ms"] == 1e3 * timings["slow"].median


def test_summary_is_median_and_quartiles():
    assert vars(summarize([5.0, 1.0, 3.0, 2.0, 4.0])) == {"median": 3.0, "low": 2.0, "high": 4.0, "count": 5}


def test_a_call_of_many_runs_tells_what_one_takes():
    assert vars(summarize([4.0, 8.0, 12.0]).of_each(4)) == {"median": 2.0, "low": 1.5, "high": 2.5, "count": 3}


@pytest.mark.gpu
def test_recorded_runs_are_replayed_unless_they_wait_for_the_device():
    total = torch.zeros((), device="cuda")
    replay = recorded(lambda: total.add_(1), 5)
    assert replay is not None
    before = float(total)
    replay()
    assert float(total) == before + 5
    assert recorded(lambda: total.item(), 5) is None
    with pytest.raises(RuntimeError, match="shape"):
        recorded(lambda: total.new_zeros(2) @ total.new_zeros(3, 3), 5)


def test_number_of_threads_is_put_back():
    before = torch.get_num_threads()
    with num_threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before


def test_order_of_convergence_is_the_slope():
    sizes = [8.0, 16.0, 32.0]
    assert fitted_order(sizes, [3 / n**2 for n in sizes]) == pytest.approx(2)
    with pytest.raises(ValueError, match="at least two positive"):
        fitted_order([1.0, 2.0], [1.0, 0.0])


def test_machine_says_what_it_is_and_what_it_reaches():
    description = describe_machine()
    assert torch.__version__.split("+")[0] == description["torch"].split("+")[0]  # "+cu130" is the build
    assert description["hardware"]
    assert description["threads"] >= 1
    rates = measure_rates(seconds=1e-9)
    assert isinstance(rates, Rates)
    assert all(row["measured"] > 0 for row in rates.rows())
