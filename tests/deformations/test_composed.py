"""One deformation after another: closed forms, and inverses where the first has none of its own."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.benchmarks.closed_flows import Rotation
from dnerf.deformations import ComposedDeformation, Deformation, FlowDeformation, IdentityDeformation
from dnerf.motion import carry


class Drift(Deformation):
    """The world moves along x by a wave of x that grows with time, which has no inverse in closed form."""

    def __init__(self, height: float) -> None:
        super().__init__()
        self.height = height

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        wave = self.height * times * torch.sin(2 * math.pi * positions[..., 0])
        return torch.cat([positions[..., :1] + wave[..., None], positions[..., 1:]], dim=-1)


def turning(rate: float = 2.0) -> FlowDeformation:
    return FlowDeformation(Rotation(rate), 0.5, num_steps=16)


def points(count: int = 200) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    positions, times = (
        torch.rand(*shape, generator=generator, dtype=torch.float64) for shape in ((count, 3), (count,))
    )
    return 2 * positions - 1, times


def test_the_first_deformation_comes_first() -> None:
    positions, times = points()
    composed = ComposedDeformation(Drift(0.1), turning())
    between = Drift(0.1)(positions, times)
    torch.testing.assert_close(composed(positions, times), turning()(between, times), rtol=0, atol=0)
    assert (composed(positions, times) - Drift(0.1)(turning()(positions, times), times)).abs().max() > 0.01


@pytest.mark.parametrize("height", [0.05, 0.15])
def test_the_inverse_finds_its_way_through_a_deformation_without_one(height: float) -> None:
    """The wave's slope is up to 0.94 for the higher one: it nearly folds there."""
    positions, times = points()
    composed = ComposedDeformation(Drift(height), turning())
    back = composed.inverse(composed(positions, times), times)
    torch.testing.assert_close(back, positions, rtol=0, atol=1e-4)


def test_points_are_carried_by_both() -> None:
    """A rotation by 2 radians a unit of time in canonical space of a world at rest: its closed form."""
    positions, times = points()
    composed = ComposedDeformation(IdentityDeformation(), turning())
    moved, residual = carry(composed, positions, times, 1.0)
    angle = 2.0 * (1 - times)
    x, y, z = positions.unbind(-1)
    expected = torch.stack(
        [x * torch.cos(angle) - y * torch.sin(angle), x * torch.sin(angle) + y * torch.cos(angle), z], dim=-1
    )
    torch.testing.assert_close(moved, expected, rtol=0, atol=1e-4)
    assert residual.max() < 1e-4
