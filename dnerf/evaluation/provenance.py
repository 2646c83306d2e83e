"""Where a number comes from: the machine, the library and the commit that made it."""

import os
import platform
import subprocess
from functools import cache
from pathlib import Path

import torch

from dnerf import __version__
from dnerf.core.process import usable_cores
from dnerf.kernels import has_bfloat16


@cache
def hardware() -> str:
    """The processor, the number of cores this process may use and the GPU if there is one, in one line."""
    parts = [f"{len(usable_cores())} x {_processor()}{'' if has_bfloat16('cpu') else ' without bfloat16'}"]
    if torch.cuda.is_available():
        parts.append(torch.cuda.get_device_name())
    return ", ".join(parts)


@cache
def commit() -> str:
    """The commit that the package was run from, "-dirty" if files differ from it; "unknown" outside a repository."""
    root = Path(__file__).parent
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude", "*", "--abbrev=12"],
            cwd=root, capture_output=True, text=True, timeout=10, check=False,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return found.stdout.strip() if found.returncode == 0 else "unknown"


def provenance() -> dict[str, str]:
    """What every file of scores carries, as plain values."""
    return {
        "hardware": hardware(), "commit": commit(), "version": __version__, "torch": torch.__version__,
        "kernels": os.environ.get("DNERF_KERNELS", "default"),
    }  # fmt: skip


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    except OSError:
        pass
    return platform.processor() or platform.machine()
