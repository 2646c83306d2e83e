"""Contraction: the box stays, all else comes to lie within twice its size."""

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


def test_what_lies_beyond_keeps_its_direction_and_stays_within_two() -> None:
    outside = places(1000, 50.0)
    unit = (outside - CENTER) / HALF
    size = unit.abs().amax(-1)
    outside, unit, size = outside[size > 1], unit[size > 1], size[size > 1]
    contracted, beyond = contract(outside, BOX)
    torch.testing.assert_close(beyond, size)
    torch.testing.assert_close(contracted.abs().amax(-1), 2 - 1 / size)
    torch.testing.assert_close(torch.cosine_similarity(contracted, unit, dim=-1), torch.ones(len(unit)).double())
    torch.testing.assert_close(contract(CENTER + 1e9 * HALF, BOX)[0], torch.full((3,), 2.0).double())


def test_it_and_its_derivative_along_the_normal_are_continuous_at_the_faces() -> None:
    face = CENTER + HALF * torch.tensor([1.0, 0.3, -0.2])
    step = torch.tensor([HALF[0] * 1e-6, 0, 0])
    before, at, behind = (contract(face + k * step, BOX)[0] for k in (-1, 0, 1))
    torch.testing.assert_close(behind, before, rtol=0, atol=3e-6)
    torch.testing.assert_close((behind - at)[0], (at - before)[0], rtol=1e-5, atol=0)


def test_gradients_are_those_of_finite_differences() -> None:
    assert torch.autograd.gradcheck(lambda x: contract(x, BOX), (places(20, 4.0).requires_grad_(),))
