"""What lies behind the scene: whether a model's background is the one that the images have."""

import torch
from torch import Tensor

from dnerf.core.backgrounds import parse_color
from dnerf.data.frames import Frames

MAX_FRAMES = 32  # whose borders are looked at, evenly spread
SAME_LEVELS = 8  # of 255: what JPEG and shading leave of one colour


def background_contradiction(color: Tensor, frames: Frames) -> str | None:
    """What the training images say against a background color (3,) in [0, 1], as a sentence for a warning, or None.

    Images that are transparent somewhere go with any background. Of opaque ones the file may state it; if it does not,
    most pixels at their borders may have one colour.
    """
    if frames.is_transparent:
        return None
    other: Tensor | None
    if frames.background is not None:
        says, other = "the data set states", torch.tensor(parse_color(frames.background))
    else:
        says, other = "most pixels at the images' borders are", border_color(frames)
    if other is None or float((color.detach().float().cpu() - other).abs().max()) <= SAME_LEVELS / 255:
        return None
    return (
        f"background is {_rounded(color)}, but {says} {_rounded(other)}: the model would explain the difference by "
        "density in empty space; set background.color"
    )


def border_color(frames: Frames) -> Tensor | None:
    """The colour (3,) in [0, 1] that most pixels at the borders of opaque images have; None if there is none."""
    chosen = torch.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().long()
    parts = []
    for index in chosen.tolist():
        image = frames.stored_image(index)[..., :3]
        parts += [image[[0, -1]].flatten(0, 1).cpu(), image[:, [0, -1]].flatten(0, 1).cpu()]
    border = torch.cat(parts).float()
    color = border.median(0).values
    share = ((border - color).abs().amax(-1) <= SAME_LEVELS).float().mean()
    return color / 255 if share > 0.5 else None


def _rounded(color: Tensor) -> list[float]:
    return [round(value, 3) for value in color.tolist()]
