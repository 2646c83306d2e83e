import os
import platform
import subprocess
import sys
import time

import pytest

from dnerf.core.process import free_core_seconds

CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1

FAULTS = """
import resource, torch
from dnerf.core.process import keep_freed_memory
made = keep_freed_memory()
for _ in range(3):
    torch.ones(16_000_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    torch.ones(16_000_000)
print(made, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

WAITING = """
import os, time, torch
from dnerf.core.process import Sleepers
values, sleepers = torch.ones(200_000), Sleepers()
for lacking in (0.0, 1.0, 0.3, 0.0):
    sleepers.adapt(lacking)
    values.add_(1.0)
    time.sleep(0.5)
    begin = time.process_time()
    for _ in range(40):
        values.add_(1.0)
        time.sleep(0.01)
    print(time.process_time() - begin, len(os.listdir("/proc/self/task")))
"""

PREPARED = """
import sys, threading
from dnerf.core.process import prepare_process
for _ in range(2):
    prepare_process()
print("torch" in sys.modules, "numpy" in sys.modules, threading.active_count())
"""


def printed(program, **environment):
    environment = {"PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "2", **environment}
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment
    ).stdout.split()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has these settings")
def test_freed_memory_is_kept_unless_switched_off():
    # 20 arrays of 64 MB are 312,500 pages of 4 KiB or 610 of 2 MiB; by default glibc maps each of them anew.
    is_kept, few = printed(FAULTS)
    is_default_kept, many = printed(FAULTS, DNERF_ALLOCATOR="default")
    assert (is_kept, is_default_kept) == ("True", "False")
    assert int(few) < 0.5 * int(many)


@pytest.mark.skipif(CORES < 2, reason="on one core GNU OpenMP never spins for long")
def test_waiting_threads_spin_only_while_enough_cores_are_free():
    found = printed(WAITING)
    seconds, threads = found[::2], found[1::2]
    free, lacking, still_lacking, free_again = map(float, seconds)
    assert max(lacking, still_lacking) < 0.5 * min(free, free_again)
    assert threads[0] == threads[3]
    assert int(threads[1]) == int(threads[2]) > int(threads[0])


@pytest.mark.skipif(CORES < 2, reason="nobody spins against anybody with one thread")
@pytest.mark.parametrize(
    ("environment", "count"),
    [({}, "2"), ({"OMP_NUM_THREADS": "1"}, "1"), ({"OMP_WAIT_POLICY": "active"}, "1"), ({"GOMP_SPINCOUNT": "9"}, "1")],
)
def test_cores_are_watched_once_unless_the_user_decides_and_no_library_is_loaded(environment, count):
    assert printed(PREPARED, **environment) == ["False", "False", count]


@pytest.mark.skipif(not os.path.exists("/proc/stat"), reason="this system does not tell who uses the cores")
def test_own_work_counts_as_free():
    begin, before = time.perf_counter(), free_core_seconds()
    own = time.process_time()
    while time.perf_counter() - begin < 0.5:
        pass
    own, seconds = time.process_time() - own, time.perf_counter() - begin
    free = free_core_seconds() - before
    # The system counts in hundredths of a second, for each core.
    assert own - 0.02 * CORES <= free <= CORES * (seconds + 0.04)
