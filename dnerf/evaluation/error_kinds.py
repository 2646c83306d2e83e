"""Where the error of images lies: at silhouettes, in gloss, texture or smooth parts, or outside of what is shown."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from dnerf.core.compositing import FieldOutput
from dnerf.fields.base import RadianceField, field_at_time

KINDS = ("silhouettes", "gloss", "texture", "smooth", "outside")
REACH = 2  # pixels about a place that are looked at
TEXTURE = 0.04  # standard deviation of grey about a place, from which on it has texture
GLOSS = 0.04  # change of a colour's mean with the direction, from which on it is gloss
TURN = math.radians(30.0)  # of that direction


class SeenFromAside(RadianceField):
    """A field whose colours are those that are seen in directions turned by 30 degrees about the z axis."""

    def __init__(self, field: RadianceField) -> None:
        super().__init__()
        self.field = field

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """The field's own."""
        return self.field.density(positions, times)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """The field's, of turned directions (..., 3)."""
        x, y, z = directions.unbind(-1)
        cosine, sine = math.cos(TURN), math.sin(TURN)
        return self.field(positions, torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1), times)

    def at_time(self, time: float, extent: Tensor | None = None) -> RadianceField:
        """The same of the field at that time."""
        return SeenFromAside(field_at_time(self.field, time, extent))


def kinds_of(image: Tensor, alpha: Tensor, change: Tensor | None = None) -> Tensor:
    """What kind of place each pixel is: numbers (H, W) int64 in `KINDS`.

    At silhouettes alpha crosses a half within two pixels. Inner places are gloss if their colour changes by more than
    `GLOSS` with the direction. Else they have texture if grey varies by more than `TEXTURE` within 5 x 5 pixels, and
    are smooth if not.

    Args:
        image: (H, W, 3) in [0, 1].
        alpha: (H, W) in [0, 1].
        change: (H, W) mean absolute change of what a model shows there, see `SeenFromAside`; None: there is no gloss.
    """
    size = 2 * REACH + 1
    inside = (alpha > 0.5).float()
    most, least = (max_pool2d(sign * inside[None, None], size, 1, REACH)[0, 0] * sign for sign in (1, -1))
    grey = image.mean(-1).double()[None, None]
    mean, square = (avg_pool2d(x, size, 1, REACH, count_include_pad=False)[0, 0] for x in (grey, grey.square()))
    has_texture = (square - mean.square()).clamp(min=0).sqrt() > TEXTURE
    inner = torch.where(has_texture, KINDS.index("texture"), KINDS.index("smooth"))
    if change is not None:
        inner = torch.where(change > GLOSS, KINDS.index("gloss"), inner)
    return torch.where(most > least, 0, torch.where(inside > 0, inner, KINDS.index("outside")))


def error_shares(errors: Tensor, kinds: Tensor) -> dict[str, tuple[float, float]]:
    """Of each kind, its share of the sum of squared errors (...), and of the pixels with numbers (...) of kinds."""
    sums = errors.new_zeros(len(KINDS), dtype=torch.float64)
    sums.index_add_(0, kinds.flatten(), errors.flatten().double())
    counts = kinds.flatten().bincount(minlength=len(KINDS)).double()
    shares = zip((sums / sums.sum()).tolist(), (counts / counts.sum()).tolist(), strict=True)
    return dict(zip(KINDS, shares, strict=True))
