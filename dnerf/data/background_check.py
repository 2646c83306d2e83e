"""What lies behind the scene: whether a model's background is the one that the images have."""

import torch
from torch import Tensor

from dnerf.core.backgrounds import parse_color
from dnerf.data.frames import Frames
from dnerf.data.pixel_layout import evenly_spread

MAX_FRAMES = 32  # whose borders are looked at, evenly spread
SAME_LEVELS = 8  # of 255: what JPEG and shading leave of one colour


def data_background(frames: Frames) -> tuple[list[float] | None, str]:
    """The colour behind training frames that a model should have, and why; None if they go with any.

    Images that are transparent somewhere do. Of opaque ones the file may state it, or most pixels at their borders have
    one colour; where they show something everywhere, it hardly matters.
    """
    if frames.is_transparent:
        return None, "any colour in training, since the images have alpha"
    if frames.background is not None:
        color = list(parse_color(frames.background))
        return color, f"{_rounded(torch.tensor(color))}, as the data set states"
    border = border_color(frames)
    if border is not None:
        return border.tolist(), f"{_rounded(border)}, which most pixels at the images' borders are"
    return [0.0, 0.0, 0.0], "black: the images are opaque and show something everywhere"


def background_contradiction(color: Tensor | None, frames: Frames) -> str | None:
    """What opaque training images say against a background color (3,) in [0, 1], as a sentence for a warning, or None.

    Raises:
        ValueError: if the data set states another colour.
    """
    if color is None or frames.is_transparent:
        return None
    behind = background_color(frames)
    if behind is None or (color.detach().float().cpu() - behind).abs().max() <= SAME_LEVELS / 255:
        return None
    shown = _rounded(behind)
    if frames.background is not None:
        raise ValueError(
            f"background must be {shown} as the data set states, got {_rounded(color)}: the model would explain the "
            "difference by density in empty space; leave background=auto, or set background=white "
            f"background.color={str(shown).replace(' ', '')}"
        )
    return (
        f"background is {_rounded(color)}, but most pixels at the images' borders are {shown}: the model "
        "would explain the difference by density in empty space; leave background=auto, or set background.color"
    )


def background_color(frames: Frames) -> Tensor | None:
    """The colour (3,) in [0, 1] behind opaque images: as the data set states, else as their borders show; else None."""
    return border_color(frames) if frames.background is None else torch.tensor(parse_color(frames.background))


def border_color(frames: Frames) -> Tensor | None:
    """The colour (3,) in [0, 1] that most pixels at the borders of opaque images have; None if there is none."""
    parts = []
    for index in evenly_spread(len(frames), MAX_FRAMES):
        image = frames.stored_image(index)[..., :3]
        parts += [image[[0, -1]].flatten(0, 1).cpu(), image[:, [0, -1]].flatten(0, 1).cpu()]
    border = torch.cat(parts).float()
    color = border.median(0).values
    share = ((border - color).abs().amax(-1) <= SAME_LEVELS).float().mean()
    return color / 255 if share > 0.5 else None


def _rounded(color: Tensor) -> list[float]:
    return [round(value, 3) for value in color.tolist()]
