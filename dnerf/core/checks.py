"""Checks of arguments at public doors: a ValueError names the argument, what was expected and what came."""

from collections.abc import Mapping, Sequence
from numbers import Real

import torch
from torch import Tensor


def check_shape(name: str, value: Tensor, shape: Sequence[int | str]) -> None:
    """Raise unless `value` has the given shape; a string in `shape` stands for any size and is printed as is."""
    wanted = [got if isinstance(want, str) else want for want, got in zip(shape, value.shape)]
    if value.dim() != len(shape) or wanted != list(value.shape):
        expected = "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name} must have shape {expected}, got {tuple(value.shape)}")


def check_batch(name: str, value: Tensor, positions: Tensor) -> None:
    """Raise unless `value` has the batch shape of `positions` (..., 3), as times must."""
    check_shape(name, value, positions.shape[:-1])


def check_positive(name: str, value: float, *, allow_zero: bool = False) -> None:
    """Raise unless a number is positive (or zero where allowed) and finite."""
    if not isinstance(value, Real):
        raise ValueError(f"{name} must be a number, got {value!r}")
    if not (value > 0 or (allow_zero and value == 0)) or value == float("inf"):
        bound = ">= 0" if allow_zero else "> 0"
        raise ValueError(f"{name} must be {bound} and finite, got {value}")


def check_whole(name: str, value: float, *, allow_zero: bool = False) -> None:
    """Raise unless a number is positive (or zero where allowed), finite and whole."""
    check_positive(name, value, allow_zero=allow_zero)
    if isinstance(value, bool) or int(value) != value:
        raise ValueError(f"{name} must be a whole number, got {value}")


def check_within(name: str, value: float | None, interval: str, *, or_none: bool = False) -> None:
    """Raise unless a number is in an interval, given as in mathematics ("(0, 1]"), or None where allowed."""
    low, high = map(float, interval[1:-1].split(","))
    if not (value is None and or_none) and not (
        value is not None
        and (low <= value if interval[0] == "[" else low < value)
        and (value <= high if interval[-1] == "]" else value < high)
    ):
        raise ValueError(f"{name} must be in {interval}{' or None' if or_none else ''}, got {value}")


def check_mapping(name: str, values: object, *, allow_zero: bool = False) -> None:
    """Raise unless `values` holds positive (or, where allowed, zero) finite numbers by name."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{name} must hold values by name, got {values!r}")
    for key, value in values.items():
        check_positive(f"{name}.{key}", value, allow_zero=allow_zero)


def check_choice(name: str, value: object, choices: Sequence[object]) -> None:
    """Raise unless `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}; got {value!r}")


def as_box(box: Sequence[Sequence[float]] | Tensor) -> Tensor:
    """Return a box as a (2, 3) float32 tensor of its lowest and highest corner; raise if it is empty or not finite."""
    corners = torch.as_tensor(box, dtype=torch.float32)
    check_shape("box", corners, (2, 3))
    if not bool(torch.isfinite(corners).all()) or not bool((corners[1] > corners[0]).all()):
        raise ValueError(f"box must have finite corners, low < high on every axis, got {corners.tolist()}")
    return corners
