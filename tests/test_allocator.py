import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource, torch
from dnerf.allocator import keep_freed_memory
made = keep_freed_memory()
for _ in range(3):
    torch.ones(16_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.ones(16_000_000)
print(made, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(setting):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True,
        env={"DNERF_ALLOCATOR": setting, "PATH": "/usr/bin:/bin"},
    )  # fmt: skip
    made, count = done.stdout.split()
    return made == "True", int(count)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has these settings")
def test_freed_memory_is_kept_unless_switched_off():
    # 20 arrays of 64 MB are 312,500 pages of 4 KiB or 610 of 2 MiB; by default glibc maps each of them anew.
    (is_kept, few), (is_default_kept, many) = faults("keep"), faults("default")
    assert is_kept
    assert not is_default_kept
    assert few < 0.5 * many
