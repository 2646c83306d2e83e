"""Declaring a compiled kernel to PyTorch as one operation, which autograd and `torch.compile` know."""

from collections.abc import Callable
from typing import Any

import torch

TAGS = (torch.Tag.pt2_compliant_tag,)  # as `custom_op` gives them: shapes and gradients hold under torch.compile


class Op:
    """An operation of `torch.ops` that returns new tensors and changes none of its arguments.

    What `torch.library.custom_op` makes does the same, but loads all of `torch.compile` when it is first called, most
    of a second that showing a picture can do without, and goes through more Python at every call.

    Args:
        name: of the operation, as in "dnerf::march", which is `torch.ops.dnerf.march`.
        function: what it does, on any device; its type hints are the operation's schema.
    """

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name = name
        self._gradients: Callable[..., Any] = self._refuse
        self._setup_context: Callable[..., None] | None = None
        torch.library.define(name, torch.library.infer_schema(function, mutates_args=()), tags=TAGS)
        torch.library.impl(name, "default", function)
        torch.library.register_autograd(name, self._backward, setup_context=self._set_up)
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
        return self._gradients(ctx, *gradients)

    def _refuse(self, ctx: Any, *gradients: Any) -> Any:
        raise RuntimeError(f"{self.name} has no autograd formula registered: it is not differentiable")


def op(name: str) -> Callable[[Callable[..., Any]], Op]:
    """Decorates the function that is run for an `Op` of a name."""
    return lambda function: Op(name, function)
