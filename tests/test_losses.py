"""Losses against their formulas."""

import math

import pytest
import torch
from reference import fog
from torch import Tensor

from dnerf.compositing import Rendering
from dnerf.losses import OpacityEntropyLoss, PhotometricLoss
from dnerf.renderer import Renderer
from dnerf.samplers import StratifiedSampler

RENDERER = Renderer(fog(), StratifiedSampler(4))


def picture(rgb: Tensor, opacity: Tensor | None = None, proposals: tuple[Rendering, ...] = ()) -> Rendering:
    opacity = torch.ones(len(rgb)) if opacity is None else opacity
    return Rendering(rgb, opacity, torch.zeros(len(rgb)), proposals=proposals)


def test_squared_error_is_the_mean_over_rays_and_channels() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    expected = sum((a - b) ** 2 for a, b in zip(rgb.flatten().tolist(), target.flatten().tolist())) / 30
    assert PhotometricLoss()(picture(rgb), target, RENDERER).item() == pytest.approx(expected, rel=1e-6)


def test_huber_error_is_quadratic_then_linear() -> None:
    loss = PhotometricLoss("huber", delta=0.1)
    target = torch.zeros(1, 3)
    small = loss(picture(torch.full((1, 3), 0.05)), target, RENDERER)
    large = loss(picture(torch.full((1, 3), 0.5)), target, RENDERER)
    assert small.item() == pytest.approx(0.05**2, rel=1e-6)
    assert large.item() == pytest.approx(2 * 0.1 * (0.5 - 0.05), rel=1e-6)


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_proposals_are_scored_with_their_weight(weight: float) -> None:
    rgb, coarse, target = torch.rand(3, 10, 3)
    loss = PhotometricLoss(proposal_weight=weight)(picture(rgb, proposals=(picture(coarse),)), target, RENDERER)
    expected = (rgb - target).square().mean() + weight * (coarse - target).square().mean()
    torch.testing.assert_close(loss, expected)


def test_entropy_is_that_of_a_coin() -> None:
    opacity = torch.tensor([0.5, 0.25])
    loss = OpacityEntropyLoss(0.1)(picture(torch.zeros(2, 3), opacity), torch.zeros(2, 3), RENDERER)
    quarter = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert loss.item() == pytest.approx(0.1 * (math.log(2) + quarter) / 2, rel=1e-6)


def test_entropy_has_finite_gradients_at_clear_and_opaque_rays() -> None:
    opacity = torch.tensor([0.0, 1.0, 1e-30, 0.5], requires_grad=True)
    OpacityEntropyLoss(1.0)(picture(torch.zeros(4, 3), opacity), torch.zeros(4, 3), RENDERER).backward()
    assert torch.isfinite(opacity.grad).all()


def test_gradcheck_of_losses() -> None:
    target = torch.rand(3, 3, dtype=torch.float64)
    rgb = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)
    opacity = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64, requires_grad=True)
    for loss in (PhotometricLoss(), PhotometricLoss("huber"), OpacityEntropyLoss(1.0)):
        assert torch.autograd.gradcheck(lambda a, b: loss(picture(a, b), target, RENDERER), (rgb, opacity))  # noqa: B023


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "l1"}, "kind must be one of mse, huber; got 'l1'"),
        ({"kind": "huber", "delta": 0.0}, "delta must be > 0"),
        ({"proposal_weight": -1.0}, "proposal_weight must be >= 0"),
    ],
)
def test_bad_photometric_loss_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhotometricLoss(**arguments)


def test_negative_entropy_weight_is_refused() -> None:
    with pytest.raises(ValueError, match="weight must be >= 0"):
        OpacityEntropyLoss(-1e-3)
