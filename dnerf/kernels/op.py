"""Declaring a compiled kernel to PyTorch as one operation, which autograd and profilers know by its name."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from .backend import run_compiled


def op(
    schema: str, kernel: str, *, backward: Callable[..., Any] | None = None,
    setup_context: Callable[..., None] | None = None, gradient_of: str | None = None,
) -> Callable[..., Any]:  # fmt: skip
    """An operation of `torch.ops.dnerf` that returns new tensors and changes none of its arguments.

    What `torch.library.custom_op` makes does the same, but loads all of `torch.compile`, most of a second, when it is
    first called, and goes through more Python at every call.

    Args:
        schema: name, arguments and results in PyTorch's own words, as in "double(Tensor x) -> Tensor".
        kernel: what runs, see `run_compiled`: module and function of it, as in "packed.weights".
        backward, setup_context: how gradients are found, see `torch.library.register_autograd`; else they are refused.
        gradient_of: the kernel whose gradient it is, if it is one.
    """
    name, _, signature = schema.partition("(")
    module, function = kernel.split(".")

    def refuse(ctx: Any, *gradients: Any) -> Any:
        if gradient_of is None:
            raise RuntimeError(f"dnerf::{name} is not differentiable")
        raise RuntimeError(
            f"the compiled {gradient_of} is differentiable once: for second derivatives run the whole computation "
            'within dnerf.kernels.use_backend("reference")'
        )

    torch.library.define(f"dnerf::{name}", f"({signature}")
    torch.library.impl(f"dnerf::{name}", "default", partial(run_compiled, module, function))
    torch.library.register_autograd(f"dnerf::{name}", backward or refuse, setup_context=setup_context)
    return getattr(torch.ops.dnerf, name).default
