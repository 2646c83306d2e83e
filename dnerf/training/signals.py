"""Being told to stop: SIGTERM and SIGINT become a request that a loop answers where its state is whole."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class TrainingStopped(Exception):
    """Training was told to stop by a signal of this number, and says where it stood."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(number, message)  # both, so that it can be pickled
        self.number = number

    def __str__(self) -> str:
        return str(self.args[1])

    @property
    def exit_code(self) -> int:
        """What a process that stops for this ends with: 128 + the signal's number, as shells count."""
        return 128 + self.number


class StopRequest:
    """Which signal has asked to stop; 0 while none has."""

    number = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Note the signal, as a signal handler."""
        self.number = self.number or number


@contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """Catch SIGTERM and SIGINT while the block lasts; the first counts, further ones change nothing.

    Terminals and cluster managers send signals more than once, and the second must not cut the saving short. SIGQUIT
    and SIGKILL still end a process at once. Outside the main thread, where Python allows no handlers, none is set.
    """
    request = StopRequest()
    is_main = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, request) for number in SIGNALS} if is_main else {}
    try:
        yield request
    finally:
        for number, handler in before.items():
            # None means a handler that was not set from Python.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
