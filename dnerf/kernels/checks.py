"""Checks of arguments that several kernels share."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.checks import check_shape


def check_shapes(**expected: tuple[Tensor, Sequence[int | str]]) -> None:
    """`check_shape` of tensors by the arguments' names."""
    for name, (value, shape) in expected.items():
        check_shape(name, value, shape)


def check_offsets(offsets: Tensor) -> None:
    """Raise ValueError unless the offsets can be those of packed samples, as far as shape and dtype say."""
    if offsets.ndim != 1 or offsets.shape[0] < 1 or offsets.dtype != torch.int64:
        raise ValueError(f"offsets must be int64 of shape (R + 1,), got {offsets.dtype} {tuple(offsets.shape)}")


def check_cells(name: str, cells: Tensor, axes: str, least: int = 0) -> None:
    """Raise ValueError unless a grid is bool, of the given axes, as in "Gx, Gy, Gz", of at least so many cells each."""
    if cells.ndim != axes.count(",") + 1 or cells.dtype != torch.bool or min(cells.shape) < least:
        expected = f"bool of shape ({axes})" + (f" of at least {least} each" if least else "")
        raise ValueError(f"{name} must be {expected}, got {cells.dtype} {tuple(cells.shape)}")
