"""What images say of what lies behind the scene is compared with what a model has there."""

from dataclasses import replace

import pytest
import torch

from dnerf.core.backgrounds import ConstantBackground
from dnerf.core.cameras import Intrinsics
from dnerf.data import Frames, random_views
from dnerf.data.background_check import background_contradiction, border_color, data_background

WHITE, BLACK = torch.ones(3), torch.zeros(3)


def frames(level: int, channels: int = 3, **changes: object) -> Frames:
    """Images of noise in front of one grey level."""
    images = torch.full((5, 12, 12, channels), level, dtype=torch.uint8)
    images[:, 2:-2, 2:-2] = torch.randint(0, 256, (5, 8, 8, channels), dtype=torch.uint8)
    if channels == 4:
        images[..., 3] = 255
    return Frames(images, *random_views(5), Intrinsics.from_angle(12, 12, 0.7), **changes)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_background_that_the_borders_contradict_is_told(channels: int) -> None:
    told = background_contradiction(WHITE, frames(0, channels))
    assert told is not None
    assert "background is [1.0, 1.0, 1.0], but most pixels at the images' borders are [0.0, 0.0, 0.0]" in told
    assert background_contradiction(BLACK, frames(0, channels)) is None
    assert background_contradiction(BLACK, frames(6, channels)) is None  # JPEG's black


def test_what_the_file_states_comes_before_the_borders_and_is_compared_as_it_comes() -> None:
    stated = frames(0, background="white")
    assert background_contradiction(WHITE, stated) is None
    with pytest.raises(ValueError, match=r"background must be \[1.0, 1.0, 1.0\] as the data set states"):
        background_contradiction(BLACK, stated)
    grey = ConstantBackground((0.2, 0.4, 0.6))(frames(0).camera(0).rays(0.0))[0]
    assert background_contradiction(grey, frames(0, background=(0.2, 0.4, 0.6))) is None


def test_transparent_images_go_with_any_background() -> None:
    transparent = frames(0, 4)
    transparent.images[3, 0, 0] = 0
    assert background_contradiction(WHITE, transparent) is None


def test_borders_say_the_colour_that_most_of_them_have_or_nothing() -> None:
    images = torch.randint(0, 256, (5, 12, 12, 3), dtype=torch.uint8)
    captured = replace(frames(0), images=images)
    assert border_color(captured) is None
    assert background_contradiction(WHITE, captured) is None
    near = frames(255)
    near.images[:, :, :3] = 10
    torch.testing.assert_close(border_color(near), WHITE)


def test_a_background_that_follows_the_data_is_what_they_state_or_show() -> None:
    transparent = frames(0, 4)
    transparent.images[3, 0, 0] = 0
    assert data_background(transparent)[0] is None
    assert data_background(frames(0, background=(0.2, 0.4, 0.6))) == (
        [0.2, 0.4, 0.6], "[0.2, 0.4, 0.6], as the data set states",
    )  # fmt: skip
    assert data_background(frames(255))[0] == [1.0, 1.0, 1.0]
    assert data_background(frames(102, 4))[0] == pytest.approx([0.4] * 3)  # an alpha channel that hides nothing
    captured = replace(frames(0), images=torch.randint(0, 256, (5, 12, 12, 3), dtype=torch.uint8))
    assert data_background(captured)[0] == [0.0, 0.0, 0.0]
