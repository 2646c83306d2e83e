"""Preparing a program's process: freed memory is kept, and threads do not spin against other programs."""

import ctypes
import os
import sys
import threading
import time
from pathlib import Path

M_TRIM_THRESHOLD = -1
M_MMAP_MAX = -4
WAIT_SETTINGS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
SECONDS_BETWEEN_LOOKS = 0.2
# Cores taken by others: from the first on threads sleep, below the second they spin again. Small services take 0.1.
LACKING, ENOUGH = 0.4, 0.25


def prepare_process() -> None:
    """See `keep_freed_memory` and `yield_to_other_programs`: for programs, once, before or after torch is loaded."""
    keep_freed_memory()
    yield_to_other_programs()


def keep_freed_memory() -> bool:
    """Tell glibc to keep freed memory for the next step instead of returning it; peak memory does not change.

    A training step frees and takes the same few large blocks, so their page faults are wasted. Only glibc has these
    settings; the environment variable DNERF_ALLOCATOR=default leaves them alone. Returns whether they were made.
    """
    if os.environ.get("DNERF_ALLOCATOR") == "default" or not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return all(mallopt(option, value) == 1 for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1)))


def yield_to_other_programs() -> bool:
    """Watch how many cores are free; while too few are, OpenMP's threads sleep when they wait instead of spinning.

    Threads that wait for each other spin for some milliseconds first, which saves the time it takes to wake them. Where
    another program wants the core, they spin against the very thread that they wait for: with one of two cores taken,
    small parallel loops took thirty times as long. Sleeping at once costs 15 % of the steps on a free machine.
    So a thread of this process looks every 0.2 s and switches. Results do not depend on it.

    Only where Linux tells who uses the cores, and with more than one thread. OMP_WAIT_POLICY or GOMP_SPINCOUNT, if the
    user sets one, decide instead. Returns whether cores are watched.
    """
    number = num_openmp_threads()
    if number == 1 or not Path("/proc/stat").is_file() or any(name in os.environ for name in WAIT_SETTINGS):
        return False
    if not any(thread.name == _watch.__name__ for thread in threading.enumerate()):
        threading.Thread(target=_watch, args=(number,), name=_watch.__name__, daemon=True).start()
    return True


def num_openmp_threads() -> int:
    """Threads that OpenMP will use: as many as this process has cores, or fewer if OMP_NUM_THREADS says so."""
    cores = len(usable_cores())
    wanted = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return min(int(wanted), cores) if wanted.isdecimal() and int(wanted) > 0 else cores


def _watch(number: int) -> None:
    sleepers, clock, free = Sleepers(), time.perf_counter(), free_core_seconds()
    while True:
        time.sleep(SECONDS_BETWEEN_LOOKS)
        last_clock, last_free = clock, free
        clock, free = time.perf_counter(), free_core_seconds()
        sleepers.adapt(number - (free - last_free) / (clock - last_clock))


def free_core_seconds() -> float:
    """Seconds that this process's cores, together, were idle or worked for it; only differences have a meaning."""
    names = {f"cpu{core}" for core in usable_cores()}
    idle = 0
    for line in Path("/proc/stat").read_text(encoding="ascii").splitlines():
        name, *ticks = line.split()
        if name in names:
            idle += int(ticks[3]) + int(ticks[4])  # idle, and idle while something is read
    return idle / os.sysconf("SC_CLK_TCK") + time.process_time()


def usable_cores() -> set[int]:
    """The cores that this process may use."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


class Sleepers:
    """Idle threads that make GNU OpenMP's threads sleep when they wait.

    Its threads spin briefly, 100 turns, while it has more of them than there are cores, and 300,000 otherwise; see
    `do_spin` in libgomp/config/linux/wait.h of GCC. Of one thread more than cores it has too many, whatever they do.
    """

    def __init__(self) -> None:
        self._end: threading.Event | None = None

    def adapt(self, lacking: float) -> None:
        """Start them if so many cores are lacking and OpenMP is loaded; let them end if enough are free again."""
        parallel = getattr(ctypes.CDLL(None), "GOMP_parallel", None)
        if lacking > LACKING and self._end is None and parallel is not None:
            self._end = threading.Event()
            threading.Thread(target=_hold_threads, args=(parallel, self._end), daemon=True).start()
        elif lacking < ENOUGH and self._end is not None:
            self._end.set()
            self._end = None


def _hold_threads(parallel: "ctypes._NamedFuncPointer", end: threading.Event) -> None:
    """A parallel region that does nothing; the threads made for it live as long as the one that entered it."""
    nothing = ctypes.CDLL(None).free  # of a null pointer
    parallel.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint)
    parallel(ctypes.cast(nothing, ctypes.c_void_p), None, len(usable_cores()) + 1, 0)
    end.wait()
