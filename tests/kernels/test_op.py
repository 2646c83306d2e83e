"""Operations are known to autograd and to torch.compile, and load neither before somebody wants it."""

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

from dnerf.kernels.op import op


@op("kernels_for_a_test::double")
def double(x: Tensor, factors: list[float]) -> Tensor:
    return 2 * x * factors[0]


@double.register_fake
def _(x: Tensor, factors: list[float]) -> Tensor:
    return torch.empty_like(x)


@op("kernels_for_a_test::halved")
def halved(x: Tensor) -> Tensor:
    return x / 2


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.factors = inputs[1]


double.register_autograd(lambda ctx, gradient: (2 * ctx.factors[0] * gradient, None), setup_context=_save)


def test_it_is_registered_under_its_name_and_has_gradients() -> None:
    x = torch.tensor([1.0, -2.0], requires_grad=True)
    y = double(x, [3.0])
    assert torch.equal(torch.ops.kernels_for_a_test.double(x, [3.0]), y)
    y.sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [6.0, 6.0]
    torch.library.opcheck(torch.ops.kernels_for_a_test.double, (x, [3.0]))


def test_without_a_formula_gradients_are_refused() -> None:
    y = halved(torch.ones(2, requires_grad=True))
    assert y.tolist() == [0.5, 0.5]
    with pytest.raises(RuntimeError, match="kernels_for_a_test::halved has no autograd formula"):
        y.sum().backward()


def test_kernels_and_their_gradients_load_no_compiler() -> None:
    """It takes a second to load, which showing a picture can do without."""
    program = """
import sys, torch
from dnerf.kernels import packed_sum
values = torch.ones(3, 2, requires_grad=True)
packed_sum(values, torch.ones(3), torch.tensor([0, 1, 3])).sum().backward()
print(values.grad.sum().item(), "torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["6.0", "False"]
