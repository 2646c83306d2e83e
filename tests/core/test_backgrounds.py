"""Backgrounds: one colour in evaluation, any in training."""

import math

import pytest
import torch

from dnerf.core.backgrounds import ConstantBackground, RandomBackground, parse_color
from dnerf.core.rays import Rays

RAYS = Rays(torch.zeros(1000, 3), torch.zeros(1000, 3), *torch.zeros(3, 1000))


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


def test_random_background_gives_the_mean_and_the_variance_of_uniform_colours_in_training() -> None:
    background = RandomBackground("black").train()
    torch.testing.assert_close(background(RAYS), torch.full((1000, 3), 0.5))
    # Of numbers in the middle of a million equal intervals.
    numbers = (torch.arange(1_000_000, dtype=torch.float64) + 0.5) / 1_000_000
    assert background.variance == pytest.approx(float(numbers.var()), rel=1e-5)
    assert torch.count_nonzero(background.eval()(RAYS)) == 0


@pytest.mark.parametrize("background", [ConstantBackground("white"), RandomBackground()])
def test_background_has_the_dtype_of_the_rays(background: ConstantBackground) -> None:
    assert background(RAYS.to(torch.float64)).dtype == torch.float64
    assert background(RAYS[:0]).shape == (0, 3)
    assert background.state_dict() == {}
