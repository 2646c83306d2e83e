"""Contraction: the box stays, all else comes to lie within twice its size."""

import pytest
import torch
from torch import Tensor

from dnerf.core.contraction import contract

BOX = torch.tensor([[-1.0, -2.0, 0.5], [3.0, 1.0, 1.5]], dtype=torch.float64)
CENTER, HALF = BOX.mean(0), 0.5 * (BOX[1] - BOX[0])


def places(count: int, reach: float) -> Tensor:
    return CENTER + HALF * reach * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).double() - 1)


def test_the_box_becomes_the_unit_cube_side_by_side() -> None:
    inside = places(100, 1.0)
    torch.testing.assert_close(contract(inside, BOX)[0], (inside - CENTER) / HALF)
    torch.testing.assert_close(contract(BOX, BOX)[0], torch.tensor([[-1.0] * 3, [1.0] * 3]).double())


def size_of(unit: Tensor, shape: str) -> Tensor:
    return unit.abs().amax(-1) if shape == "box" else unit.norm(dim=-1)


@pytest.mark.parametrize("shape", ["box", "ball"])
def test_what_lies_beyond_keeps_its_direction_and_stays_within_two(shape: str) -> None:
    outside = places(1000, 50.0)
    unit = (outside - CENTER) / HALF
    size = size_of(unit, shape)
    outside, unit, size = outside[size > 1], unit[size > 1], size[size > 1]
    contracted, beyond = contract(outside, BOX, shape)
    torch.testing.assert_close(beyond, size)
    torch.testing.assert_close(size_of(contracted, shape), 2 - 1 / size)
    torch.testing.assert_close(torch.cosine_similarity(contracted, unit, dim=-1), torch.ones(len(unit)).double())
    farthest = torch.full((3,), 2.0 if shape == "box" else 2 / 3**0.5).double()
    torch.testing.assert_close(contract(CENTER + 1e9 * HALF, BOX, shape)[0], farthest)


@pytest.mark.parametrize(("shape", "aside"), [("box", (0.3, -0.2)), ("ball", (0.0, 0.0))])
def test_it_and_its_derivative_along_the_normal_are_continuous_at_the_faces(
    shape: str, aside: tuple[float, float]
) -> None:  # fmt: skip
    face = CENTER + HALF * torch.tensor([1.0, *aside])
    step = torch.tensor([HALF[0] * 1e-6, 0, 0])
    before, at, behind = (contract(face + k * step, BOX, shape)[0] for k in (-1, 0, 1))
    torch.testing.assert_close(behind, before, rtol=0, atol=3e-6)
    torch.testing.assert_close((behind - at)[0], (at - before)[0], rtol=1e-5, atol=0)


@pytest.mark.parametrize("shape", ["box", "ball"])
def test_gradients_are_those_of_finite_differences(shape: str) -> None:
    assert torch.autograd.gradcheck(lambda x: contract(x, BOX, shape), (places(20, 4.0).requires_grad_(),))
    middle = CENTER.clone().requires_grad_()
    contract(middle, BOX, shape)[0].sum().backward()
    torch.testing.assert_close(middle.grad, 1 / HALF)
