"""Calls under one of the kernels' backends."""

from collections.abc import Callable
from typing import Any

from dnerf import kernels


def under(backend: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """What a function returns while a backend is selected."""
    with kernels.use_backend(backend):
        return function(*arguments, **options)
