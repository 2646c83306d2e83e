# mypy: disable-error-code="attr-defined"
"""Starting numba kernels on as many threads as torch uses."""

import os
import threading
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache
from typing import Any

import numba
import torch

# OpenMP first: its pool gets along with torch's, where the other layers' threads fight torch's spinning workers
# for the cores (measured: 6 ms lost per switch with workqueue), and it may be entered from several Python threads.
# Where it is GNU OpenMP, as on Linux, kernels cannot run in a forked child: data loaders that need them must spawn.
if "NUMBA_THREADING_LAYER" not in os.environ and "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]

# No assumption that values are finite: NaN and inf keep their meaning.
FAST = {"contract", "nsz"}

# numba counts references to arrays at every call between compiled functions, atomically, which can take longer than
# the call. Functions that only look at arrays which somebody else holds, and make or return none, do without. Divisions
# by zero are infinite or NaN in them, as in the bodies of parallel loops.
BORROWS: dict[str, Any] = {"_nrt": False, "error_model": "numpy"}


def num_threads() -> int:
    """Threads a kernel started now may use: torch's number, as far as numba has started so many."""
    return min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS)


def launch(kernel: Callable[..., Any], *arguments: Any) -> None:
    """Run a parallel numba kernel on `num_threads()` threads; safe from several Python threads at once."""
    threads = num_threads()
    numba.set_num_threads(threads)
    with _turn():
        kernel(*arguments)
    # Starting its OpenMP pool, numba also sets the number of threads that torch goes by.
    if torch.get_num_threads() != threads and threads < numba.config.NUMBA_NUM_THREADS:
        torch.set_num_threads(threads)


@cache
def _turn() -> Any:
    """A lock if numba could only find its own pool, which two threads must not enter together; else nothing."""
    return threading.Lock() if numba.threading_layer() == "workqueue" else nullcontext()
