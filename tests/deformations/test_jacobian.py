"""What is said of deformations whose derivatives are known."""

import pytest
import torch
from torch import Tensor

from dnerf.deformations import Deformation
from dnerf.deformations.inversion import folding


class Squash(Deformation):
    """x is multiplied by the time less a half, so that space folds in the first half; y is stretched, z stays."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        x, y, z = positions.unbind(-1)
        return torch.stack([x * (times - 0.5), 2 * y, z], dim=-1)


def test_determinant_share_and_stretch_are_those_of_the_map() -> None:
    times = torch.linspace(0, 1, 101, dtype=torch.float64)
    positions = torch.randn(101, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = folding(Squash(), positions, times)
    assert found.least_determinant == pytest.approx(-1.0)
    assert found.share_folded == pytest.approx(50 / 101)
    # Of |t - 1/2|: 0, then each of 0.01, 0.02, ... 0.5 twice.
    assert found.stretch == pytest.approx((0.03, 0.48))


def test_any_shape_of_places_will_do_but_none() -> None:
    positions, times = torch.ones(4, 5, 3), torch.ones(4, 5)
    assert folding(Squash(), positions, times).least_determinant == pytest.approx(1.0)
    with pytest.raises(ValueError, match="at least one"):
        folding(Squash(), positions[:0], times[:0])
