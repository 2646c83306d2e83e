import itertools

import pytest
import torch
from torch import Tensor, nn

from dnerf.deformations import (
    AlongRaysDeformation,
    CachedAtTime,
    CachedDeformation,
    Deformation,
    IdentityDeformation,
    deform_along_rays,
    unwrapped,
)


class Bend(Deformation):
    """x' = x + a t + b x_0 + c x_0^2, for which interpolation is exact but for c."""

    def __init__(self, square: float = 0.0) -> None:
        super().__init__()
        self.rate = nn.Parameter(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
        self.slope = nn.Parameter(torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64))
        self.square = square
        self.num_points = 0

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        self.num_points += len(positions)
        x = positions[..., :1]
        return positions + self.rate * times[..., None] + self.slope * x + self.square * x.square()


def rays(count: int, size: int, length: float = 1.0) -> tuple[Tensor, Tensor]:
    """Samples (count, size, 3) of rays of a length, and their times."""
    generator = torch.Generator().manual_seed(5)
    origins, directions = torch.randn(2, count, 1, 3, generator=generator, dtype=torch.float64)
    along = torch.linspace(0, length, size, dtype=torch.float64)[:, None]
    times = torch.rand(count, 1, generator=generator, dtype=torch.float64).expand(count, size)
    return origins + along * directions / directions.norm(dim=-1, keepdim=True), times


def test_where_displacements_are_linear_a_few_evaluations_are_exact() -> None:
    bend, (positions, times) = Bend(), rays(7, 101)
    moved = deform_along_rays(bend, positions, times, 0.1, pad_to=1)
    assert bend.num_points <= 7 * 12
    torch.testing.assert_close(moved, bend(positions, times))


def test_gradients_to_parameters_are_those_of_evaluating_everywhere_where_displacements_are_linear() -> None:
    bend, (positions, times) = Bend(), rays(7, 101)
    weights = torch.randn(positions.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = torch.autograd.grad((deform_along_rays(bend, positions, times, 0.1) * weights).sum(), bend.parameters())
    expected = torch.autograd.grad((bend(positions, times) * weights).sum(), bend.parameters())
    torch.testing.assert_close(found, expected)


def test_error_falls_with_the_square_of_the_spacing_and_stays_below_its_bound() -> None:
    bend, (positions, times) = Bend(square=1.0), rays(3, 6401)
    exact, errors = bend(positions, times), []
    for spacing in (0.08, 0.04, 0.02):
        error = (deform_along_rays(bend, positions, times, spacing) - exact).detach().norm(dim=-1).max()
        assert float(error) <= 2 * 3**0.5 * (2 * spacing) ** 2 / 8  # the second derivative is at most 2 per axis
        errors.append(float(error))
    ratios = [a / b for a, b in itertools.pairwise(errors)]
    assert ratios == pytest.approx([4, 4], rel=0.15)  # rows' last parts differ in length


def test_scattered_points_are_all_evaluated() -> None:
    bend, points = Bend(square=1.0), torch.randn(50, 3, dtype=torch.float64)
    times = torch.rand(50, dtype=torch.float64)
    assert torch.equal(deform_along_rays(bend, points, times, 0.1), bend(points, times))


def test_no_points_are_no_error() -> None:
    empty = torch.zeros(0, 3, dtype=torch.float64)
    assert deform_along_rays(Bend(), empty, empty[:, 0], 0.1).shape == (0, 3)


def test_gradients_are_right_by_finite_differences() -> None:
    positions, times = rays(2, 12, 0.3)
    bend = Bend(square=0.5)

    def moved(rate: Tensor, slope: Tensor) -> Tensor:
        return torch.func.functional_call(_Along(bend), {"bend.rate": rate, "bend.slope": slope}, (positions, times))

    assert torch.autograd.gradcheck(moved, tuple(p.detach().clone().requires_grad_() for p in bend.parameters()))


def test_samples_of_a_ray_share_evaluations_in_training_only() -> None:
    bend, (positions, times) = Bend(), rays(7, 101)
    along = AlongRaysDeformation(bend, 0.1)
    exact = bend(positions, times)
    for is_training in (True, False):
        bend.num_points = 0
        torch.testing.assert_close(along.train(is_training)(positions, times), exact)
        assert bend.num_points == (1024 if is_training else 7)  # 84 samples in training, padded; all rows of seven rays
    assert unwrapped(along) is bend


def test_frames_are_those_of_the_other_deformation() -> None:
    bend = Bend()
    assert AlongRaysDeformation(bend, 0.1).at_time(0.3) is bend
    box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert isinstance(AlongRaysDeformation(CachedDeformation(bend, box, 4), 0.1).at_time(0.3), CachedAtTime)
    positions, times = rays(2, 5)
    assert torch.equal(AlongRaysDeformation(IdentityDeformation(), 0.1)(positions, times), positions)


@pytest.mark.parametrize("spacing", [0.0, -0.1, float("nan"), float("inf")])
def test_a_spacing_that_is_not_positive_is_refused(spacing: float) -> None:
    with pytest.raises(ValueError, match="spacing must be > 0 and finite"):
        AlongRaysDeformation(Bend(), spacing)


class _Along(nn.Module):
    def __init__(self, bend: Bend) -> None:
        super().__init__()
        self.bend = bend

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return deform_along_rays(self.bend, positions, times, 0.1, pad_to=1)
