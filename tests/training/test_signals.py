"""Signals become requests while they are asked for, and are what they were before and after."""

import contextlib
import os
import pickle
import signal
import threading

import pytest

from dnerf.training.signals import SIGNALS, StopRequest, TrainingStopped, stop_requests


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_counts_and_further_ones_change_nothing(number: signal.Signals) -> None:
    with stop_requests() as request:
        assert request.number == 0
        for each in (number, *SIGNALS):
            os.kill(os.getpid(), each)
            assert request.number == number
    stop = TrainingStopped(number, "stopped after step 7")
    assert (stop.exit_code, str(stop)) == (128 + number, "stopped after step 7")


def test_handlers_are_put_back_even_after_an_error() -> None:
    def mine(number: int, frame: object) -> None:
        pass

    before, interrupt = signal.signal(signal.SIGTERM, mine), signal.getsignal(signal.SIGINT)
    try:
        with contextlib.suppress(KeyError), stop_requests():
            assert signal.getsignal(signal.SIGTERM) is not mine
            raise KeyError
        assert signal.getsignal(signal.SIGTERM) is mine
        assert signal.getsignal(signal.SIGINT) is interrupt  # ignored, where a shell started this behind its back
    finally:
        signal.signal(signal.SIGTERM, before)


def test_other_threads_get_a_request_that_never_comes() -> None:
    seen: list[StopRequest] = []

    def work() -> None:
        with stop_requests() as request:
            seen.append(request)

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen[0].number == 0
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_stop_can_be_sent_between_processes() -> None:
    stop = pickle.loads(pickle.dumps(TrainingStopped(15, "stopped")))  # noqa: S301
    assert (stop.number, str(stop), stop.exit_code) == (15, "stopped", 143)
