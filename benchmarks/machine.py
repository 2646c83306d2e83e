"""What the machine is and what it can do: names, versions, and the rates measured in the same run as a benchmark."""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import torch

from benchmarks.timing import time_in_turn
from dnerf.evaluation.provenance import commit, hardware

PACKAGES = ("torch", "numpy", "numba", "triton", "torchdiffeq")


def describe_machine() -> dict[str, Any]:
    """Hardware, versions and commit, as a report records them. What cannot be found out is "unknown"."""
    return {
        "hardware": hardware(), "threads": torch.get_num_threads(), "memory_GiB": _memory_gib(),
        "system": platform.platform(terse=True), "python": platform.python_version(),
        **{name: _version(name) for name in PACKAGES}, "commit": commit(),
    }  # fmt: skip


def _memory_gib() -> float | str:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return "unknown"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


@dataclass(frozen=True)
class Rates:
    """What the machine reaches on the two things that bound every program.

    Args:
        flops: operations per second of a large matrix product by dtype, a multiply-add being two.
        bandwidth: bytes per second of a copy much larger than the caches, reads and writes both counted.
        cached_bandwidth: the same for a copy that stays in the caches (256 KiB).
    """

    flops: Mapping[torch.dtype, float]
    bandwidth: float
    cached_bandwidth: float

    def rows(self) -> list[dict[str, Any]]:
        """Rows of a table."""
        rates = [
            (f"matrix product, {str(d).removeprefix('torch.')}", f / 1e9, "Gflop/s") for d, f in self.flops.items()
        ]
        rates += [
            ("copy, far larger than the caches", self.bandwidth / 1e9, "GB/s"),
            ("copy, 256 KiB", self.cached_bandwidth / 1e9, "GB/s"),
        ]
        return [{"limit": name, "measured": rate, "unit": unit} for name, rate, unit in rates]


def measure_rates(device: str = "cpu", *, seconds: float = 1.0) -> Rates:
    """Measure matrix rate and copy bandwidth with torch's present number of threads.

    Args:
        device: where.
        seconds: for each of them.
    """
    size = 4096 if device == "cuda" else 1024
    flops = {}
    for dtype in (torch.float32, torch.bfloat16):
        a, b = (torch.randn(size, size, device=device).to(dtype) for _ in range(2))
        out = torch.empty_like(a)
        taken = time_in_turn({"mm": _product(a, b, out)}, seconds=seconds, device=device)["mm"]
        flops[dtype] = 2 * size**3 / taken.low
    large = torch.zeros(1 << 26, device=device)  # 256 MiB
    small = torch.zeros(1 << 15, device=device)  # 128 KiB, and as much for the copy
    bandwidths = []
    for source, copies in ((large, 1), (small, 200)):
        taken = time_in_turn({"copy": _copies(source, copies)}, seconds=seconds, device=device)["copy"]
        bandwidths.append(2 * source.numel() * source.element_size() * copies / taken.low)
    return Rates(flops, *bandwidths)


def _product(a: torch.Tensor, b: torch.Tensor, out: torch.Tensor) -> Any:
    return lambda: torch.mm(a, b, out=out)


def _copies(source: torch.Tensor, count: int) -> Any:
    target = torch.empty_like(source)

    def run() -> None:
        for _ in range(count):
            target.copy_(source)

    return run
