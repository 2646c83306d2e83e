"""Declaring a compiled kernel to PyTorch as one operation, which autograd and `torch.compile` know."""

from collections.abc import Callable
from typing import Any

import torch


class Op:
    """An operation of `torch.ops` that returns new tensors and changes none of its arguments.

    What `torch.library.custom_op` makes would load all of `torch.compile` when it is first called, a second that
    showing a picture can do without, and would take 10 microseconds more a call.

    Args:
        name: of the operation, as in "dnerf::march", which is `torch.ops.dnerf.march`.
        function: what it does, on any device; its type hints are the operation's schema.
    """

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name = name
        schema = torch.library.infer_schema(function, mutates_args=())
        torch.library.define(self.name, schema, tags=(torch.Tag.pt2_compliant_tag,))
        torch.library.impl(self.name, "default", function)
        self._setup_context: Callable[..., None] | None = None
        self._gradients: Callable[..., Any] | None = None
        torch.library.register_autograd(self.name, self._backward, setup_context=self._set_up)
        space, own_name = name.split("::")
        self._overload = getattr(getattr(torch.ops, space), own_name).default

    def __call__(self, *arguments: Any) -> Any:
        return self._overload(*arguments)

    def register_fake(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorates a function that makes tensors as those which the operation returns, without values."""
        torch.library.register_fake(self.name, function)
        return function

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
        """Say how gradients are found; both arguments as those of `torch.library.register_autograd`."""
        self._gradients, self._setup_context = backward, setup_context

    def _set_up(self, ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        if self._setup_context is not None:
            self._setup_context(ctx, inputs, output)

    def _backward(self, ctx: Any, *gradients: Any) -> Any:
        if self._gradients is None:
            raise RuntimeError(f"{self.name} has no autograd formula registered: it is not differentiable")
        return self._gradients(ctx, *gradients)


def op(name: str) -> Callable[[Callable[..., Any]], Op]:
    """Decorates the function that is run for an `Op` of a name."""
    return lambda function: Op(name, function)
