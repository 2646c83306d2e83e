"""Operations are known to autograd by name, and load no compiler."""

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch.library import opcheck

from dnerf.kernels import GridLevels

LEVELS = GridLevels((2, 5), 64)


def arguments_of_operations() -> dict[str, tuple[Any, ...]]:
    """Five samples on three rays, and places on a grid."""
    depth, values, offsets = torch.rand(5).double(), torch.rand(5, 3).double(), torch.tensor([0, 2, 2, 5])
    grid = torch.rand(5, 3).double(), torch.rand(LEVELS.num_rows, 2).double(), LEVELS.cells, LEVELS.max_rows
    ray = torch.tensor([[-2.0, 0.1, 0.2]]), torch.tensor([[1.0, 0.0, 0.0]]), torch.zeros(1), torch.full((1,), 5.0)
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    return {
        "march": (torch.ones(1, 4, 4, 4) > 0, [*ray, torch.zeros(1), torch.zeros(1)], box, 0.5, None, None),
        "packed_weights": (depth, offsets),
        "packed_weights_grad": (depth, depth, depth, offsets),
        "packed_sum": (values, depth, offsets),
        "packed_sum_grad_values": (values[:3], depth, offsets, 5),
        "packed_sum_grad_weights": (values[:3], values, offsets),
        "grid_encode": (*grid, False),
        "grid_encode_grad_table": (torch.rand(5, 4).double(), *grid),
        "grid_encode_grad_positions": (torch.rand(5, 4).double(), *grid),
    }


@pytest.mark.parametrize("name", arguments_of_operations())
def test_operations_change_no_argument_and_return_new_tensors(name: str) -> None:
    opcheck(getattr(torch.ops.dnerf, name), arguments_of_operations()[name], test_utils=["test_schema"])


def test_without_a_formula_gradients_are_refused() -> None:
    cells, rays, *others = arguments_of_operations()["march"]
    starts, *_ = torch.ops.dnerf.march(cells, [x.requires_grad_() for x in rays], *others)
    with pytest.raises(RuntimeError, match="dnerf::march is not differentiable"):
        starts.sum().backward()


def test_kernels_and_their_gradients_load_no_compiler() -> None:
    """It takes a second to load, which an image can do without."""
    program = """
import sys, torch
from dnerf.kernels import packed_sum
values = torch.ones(3, 2, requires_grad=True)
packed_sum(values, torch.ones(3), torch.tensor([0, 1, 3])).sum().backward()
print(values.grad.sum().item(), "torch._dynamo" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["6.0", "False"]
