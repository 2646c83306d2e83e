# mypy: disable-error-code="attr-defined"
"""Compiling numba kernels, and what they are started with: arrays, and tasks for as many threads as torch uses."""

import hashlib
import os
import threading
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

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


def kernel(parallel: bool = True, **options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorates a function that Python starts: compiled without the interpreter's lock and kept on disk.

    numba takes what it kept as long as the file that a kernel stands in has not changed. Kernels are made of functions
    and constants from other files too, so each state of all of them has a folder of its own.
    """

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        before = numba.config.CACHE_DIR
        numba.config.CACHE_DIR = str(_cache_folder())
        try:
            return numba.njit(parallel=parallel, cache=True, nogil=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before

    return compiled


@cache
def _cache_folder() -> Path:
    """In $NUMBA_CACHE_DIR; without it beside this file, or where that cannot be written, among the user's caches."""
    here = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(here.parent.rglob("*.py")):
        digest.update(f"{path.relative_to(here.parent)}\n".encode() + path.read_bytes())
    beside = here / "__pycache__"
    writable = os.access(beside if beside.exists() else here, os.W_OK)
    users = Path(os.path.expanduser("~"), ".cache", "dnerf")
    return Path(numba.config.CACHE_DIR or (beside if writable else users)) / f"kernels-{digest.hexdigest()[:16]}"


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


def none_taken() -> np.ndarray:
    """The counter that `next_task` wants; tasks are dealt out as threads come free: a slow core holds nobody up."""
    return np.zeros(1, np.int64)


@intrinsic
def next_task(typing: Any, taken: Any) -> tuple[Any, Any]:
    """The number of the next task, counted from 0, that no thread has taken."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        counter = context.make_array(taken)(context, builder, arguments[0]).data
        return builder.atomic_rmw("add", counter, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(taken), generate


def array(tensor: Tensor) -> np.ndarray:
    """The numbers of a tensor, contiguous; those in bfloat16 as uint16, bit by bit."""
    tensor = tensor.detach().contiguous()
    return tensor.view(torch.int16).numpy().view(np.uint16) if tensor.dtype == torch.bfloat16 else tensor.numpy()


def offsets_array(offsets: Tensor, num_samples: int) -> np.ndarray:
    """Offsets (R + 1,) that run from 0 to the number of samples, or a ValueError."""
    numbers = array(offsets)
    if numbers[0] != 0 or numbers[-1] != num_samples:
        raise ValueError(f"offsets must run from 0 to {num_samples}, got {numbers[0]} to {numbers[-1]}")
    return numbers


def rows_array(name: str, rows: Tensor, size: int) -> np.ndarray:
    """Numbers of rows of a table of so many, or a ValueError."""
    numbers = array(rows)
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= size):
        raise ValueError(f"{name} must lie in [0, {size}), got {numbers.min()} to {numbers.max()}")
    return numbers
