"""Which implementation of the kernels runs: the plain-torch definition, numba on the CPU, or Triton on a GPU."""

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

BACKENDS = ("auto", "reference", "numba", "triton")
COMPILED_DTYPES = (torch.float32, torch.float64)

# Process-wide on purpose: autograd runs CUDA backward passes in threads of its own, which a context variable
# would not reach. The name is checked where it is used, so that a misspelt variable does not break the import.
_selected = os.environ.get("DNERF_KERNELS", "auto")


def get_backend() -> str:
    """The selected backend's name, one of `BACKENDS`."""
    return _selected


def set_backend(name: str) -> None:
    """Select the implementation that every kernel uses from now on, in this process.

    `"auto"` takes Triton for CUDA tensors where it is installed, numba for CPU tensors, and the reference otherwise.
    The environment variable `DNERF_KERNELS` gives the initial choice.

    Args:
        name: one of `BACKENDS`. `"reference"` is differentiable to any order; the others once.

    Raises:
        ValueError: the name is unknown, or Triton is asked for and not installed.
    """
    global _selected
    _check_name(name)
    _selected = name


@contextmanager
def use_backend(name: str) -> Iterator[None]:
    """Select a backend inside a `with` block; arguments and errors as in `set_backend`."""
    previous = _selected
    set_backend(name)
    try:
        yield
    finally:
        set_backend(previous)


def choose(tensor: Tensor) -> str:
    """The implementation that serves this tensor: `"reference"`, `"numba"` or `"triton"`.

    Raises:
        ValueError: the selected backend is unknown, not installed, or cannot work on the tensor's device.
    """
    name = _selected
    if name == "auto":
        if tensor.is_cuda and has_triton():
            return "triton"
        return "numba" if tensor.is_cpu and tensor.dtype in COMPILED_DTYPES else "reference"
    _check_name(name)
    if name == "numba" and not tensor.is_cpu:
        raise ValueError(f"kernel backend 'numba' needs tensors on the CPU, got {tensor.device}")
    if name == "triton" and not (tensor.is_cuda or os.environ.get("TRITON_INTERPRET") == "1"):
        raise ValueError(f"kernel backend 'triton' needs CUDA tensors (or TRITON_INTERPRET=1), got {tensor.device}")
    return name


def run_compiled(op: str, function: str, tensor: Tensor, *arguments: Any) -> Any:
    """Call the compiled version that serves a tensor, with the tensor as first argument.

    The module is imported on first use, since numba and Triton load slowly.
    """
    if tensor.is_cuda:
        with torch.cuda.device(tensor.device):
            return getattr(import_module(f"dnerf.kernels.gpu.{op}"), function)(tensor, *arguments)
    folder = "gpu" if _selected == "triton" else "cpu"
    return getattr(import_module(f"dnerf.kernels.{folder}.{op}"), function)(tensor, *arguments)


@cache
def has_triton() -> bool:
    """Whether Triton can be imported."""
    return importlib.util.find_spec("triton") is not None


def _check_name(name: str) -> None:
    if name not in BACKENDS:
        raise ValueError(f"kernel backend must be one of {', '.join(BACKENDS)}, got {name!r}")
    if name == "triton" and not has_triton():
        raise ValueError("kernel backend 'triton' needs the package triton, which is not installed")
