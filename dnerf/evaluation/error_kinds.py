"""Where the error of images lies: at silhouettes, in texture, in smooth parts, or outside of what is shown."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

KINDS = ("silhouettes", "texture", "smooth", "outside")
REACH = 2  # pixels about a place that are looked at
TEXTURE = 0.04  # standard deviation of grey about a place, from which on it has texture


def kinds_of(image: Tensor, alpha: Tensor) -> Tensor:
    """What kind of place each pixel is: numbers (H, W) int64 in `KINDS`.

    At silhouettes alpha crosses a half within two pixels. Inner places have texture if grey varies by more than
    `TEXTURE` within 5 x 5 pixels, else they are smooth.

    Args:
        image: (H, W, 3) in [0, 1].
        alpha: (H, W) in [0, 1].
    """
    size = 2 * REACH + 1
    inside = (alpha > 0.5).float()
    most, least = (max_pool2d(sign * inside[None, None], size, 1, REACH)[0, 0] * sign for sign in (1, -1))
    grey = image.mean(-1).double()[None, None]
    mean, square = (avg_pool2d(x, size, 1, REACH, count_include_pad=False)[0, 0] for x in (grey, grey.square()))
    has_texture = (square - mean.square()).clamp(min=0).sqrt() > TEXTURE
    inner = torch.where(has_texture, KINDS.index("texture"), KINDS.index("smooth"))
    return torch.where(most > least, 0, torch.where(inside > 0, inner, KINDS.index("outside")))


def error_shares(errors: Tensor, kinds: Tensor) -> dict[str, tuple[float, float]]:
    """Of each kind, its share of the sum of squared errors (...), and of the pixels with numbers (...) of kinds."""
    sums = errors.new_zeros(len(KINDS), dtype=torch.float64)
    sums.index_add_(0, kinds.flatten(), errors.flatten().double())
    counts = kinds.flatten().bincount(minlength=len(KINDS)).double()
    shares = zip((sums / sums.sum()).tolist(), (counts / counts.sum()).tolist(), strict=True)
    return dict(zip(KINDS, shares, strict=True))
