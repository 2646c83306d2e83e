"""The C allocator's settings: glibc returns large blocks to the system and pays page faults to get them back."""

import ctypes
import os
import sys

M_TRIM_THRESHOLD = -1
M_MMAP_MAX = -4


def keep_freed_memory() -> bool:
    """Tell glibc to keep freed memory for the next step instead of returning it; peak memory does not change.

    A training step frees and takes the same few large blocks, so their page faults are wasted. How much time that
    is depends on the machine: nothing measurable where faults are cheap. Only glibc has these
    settings; the environment variable DNERF_ALLOCATOR=default leaves them alone.

    Returns:
        Whether the settings were made.
    """
    if os.environ.get("DNERF_ALLOCATOR") == "default" or not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return all(mallopt(option, value) == 1 for option, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1)))
