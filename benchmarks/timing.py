"""Timing: medians with spread, variants measured in turn so that whatever disturbs one disturbs all."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from dnerf.core.checks import check_positive


@dataclass(frozen=True)
class Timing:
    """Seconds of one call.

    Args:
        median: over all calls.
        low: first quartile.
        high: third quartile.
        count: number of calls.
    """

    median: float
    low: float
    high: float
    count: int

    def of_each(self, number: int) -> "Timing":
        """The timing of one of so many equal parts of the call."""
        return Timing(self.median / number, self.low / number, self.high / number, self.count)

    @property
    def milliseconds(self) -> dict[str, float]:
        """Columns of a table row."""
        return {"median_ms": 1e3 * self.median, "low_ms": 1e3 * self.low, "high_ms": 1e3 * self.high}


def time_in_turn(
    calls: Mapping[str, Callable[[], object]], *, seconds: float = 1.0, min_repeats: int = 5, device: str = "cpu"
) -> dict[str, Timing]:
    """Time several calls round robin: each round runs every call once, so ratios hold on a machine that wavers.

    The first round warms up and does not count.

    Args:
        calls: what to time, by name.
        seconds: for all rounds together; at least `min_repeats` rounds are run whatever they take.
        min_repeats: fewest rounds.
        device: "cuda" waits for the device before the clock is read.

    Raises:
        ValueError: if seconds or rounds are not positive.
    """
    check_positive("seconds", seconds)
    check_positive("min_repeats", min_repeats)
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    begin = time.perf_counter()
    rounds = 0
    while rounds < min_repeats or time.perf_counter() - begin < seconds:
        for name, call in calls.items():
            _wait(device)
            start = time.perf_counter()
            call()
            _wait(device)
            taken[name].append(time.perf_counter() - start)
        rounds += 1
    return {name: summarize(values) for name, values in taken.items()}


def recorded(call: Callable[[], object], number: int) -> Callable[[], object] | None:
    """So many runs of a call as one CUDA graph: what the device takes, without Python between its kernels.

    Args:
        call: does the same every time, in memory that stays where it is.
        number: of runs in the graph.

    Returns:
        What replays the graph, or None for a call that waits for the device and so cannot be recorded.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    mode = torch.cuda.get_sync_debug_mode()
    with torch.cuda.stream(stream):
        call()  # compiles, and may wait for that
        torch.cuda.set_sync_debug_mode("error")
        try:
            call()
        except RuntimeError as error:
            if "synchronizing" not in str(error):
                raise
            return None
        finally:
            torch.cuda.set_sync_debug_mode(mode)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, stream=stream):
        for _ in range(number):
            call()
    return graph.replay


def summarize(values: list[float]) -> Timing:
    """Median and quartiles of some seconds."""
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    return Timing(float(median), float(low), float(high), len(values))


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


@contextmanager
def num_threads(count: int) -> Iterator[None]:
    """Let torch (and the compiled kernels, which follow it) use so many threads within a `with` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def fitted_order(sizes: list[float], errors: list[float]) -> float:
    """Slope of -log(error) against log(size) by least squares: the order of convergence.

    Raises:
        ValueError: with fewer than two positive errors.
    """
    kept = [(math.log(n), math.log(e)) for n, e in zip(sizes, errors, strict=True) if e > 0]
    if len(kept) < 2:
        raise ValueError(f"errors must hold at least two positive numbers, got {errors}")
    x, y = np.array(kept).T
    return -float(np.polyfit(x, y, 1)[0])
