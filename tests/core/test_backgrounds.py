"""Backgrounds: constant in evaluation, random only in training."""

import math

import pytest
import torch

from dnerf.core.backgrounds import ConstantBackground, RandomBackground, parse_color
from dnerf.core.rays import Rays

RAYS = Rays(torch.zeros(1000, 3), torch.zeros(1000, 3), *torch.zeros(3, 1000))


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("color", "expected"),
    [("white", (1, 1, 1)), ("black", (0, 0, 0)), ([0.25, 0.5, 1], (0.25, 0.5, 1)), ((0, 0, 0), (0, 0, 0))],
)
def test_colours_have_names_or_numbers(color: object, expected: tuple[float, ...]) -> None:
    assert parse_color(color) == expected
    background = ConstantBackground(color)(RAYS)
    assert background.shape == (1000, 3)
    assert (background == torch.tensor(expected)).all()


@pytest.mark.parametrize("color", ["red", "", [0, 0], [0, 0, 0, 0], [0, 0, 1.5], [-0.1, 0, 0], [math.nan, 0, 0]])
def test_other_colours_are_refused(color: object) -> None:
    with pytest.raises(ValueError, match="color must be"):
        ConstantBackground(color)


def test_random_background_is_another_uniform_colour_for_every_ray_in_training() -> None:
    colors = RandomBackground("black").train()(RAYS, generator=seeded(0))
    assert len(colors.unique(dim=0)) == 1000
    assert 0 <= colors.min() < 0.01 < 0.99 < colors.max() <= 1
    # The mean of 1000 uniform numbers, within four standard deviations.
    torch.testing.assert_close(colors.mean(0), torch.full((3,), 0.5), rtol=0, atol=4 / math.sqrt(12 * 1000))


@pytest.mark.parametrize("background", [ConstantBackground("white"), RandomBackground()])
def test_background_has_the_dtype_of_the_rays(background: ConstantBackground) -> None:
    assert background(RAYS.to(torch.float64)).dtype == torch.float64
    assert background(RAYS[:0]).shape == (0, 3)
    assert background.state_dict() == {}
