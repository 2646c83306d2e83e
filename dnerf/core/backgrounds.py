"""What lies behind the scene: one colour, or in training any."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.rays import Rays

COLORS: dict[str, tuple[float, float, float]] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def parse_color(color: str | Sequence[float]) -> tuple[float, float, float]:
    """Return a colour given by name ("white", "black") or as three numbers in [0, 1]. Raises ValueError for another
    name, another length or a number outside [0, 1]."""
    if isinstance(color, str):
        if color not in COLORS:
            raise ValueError(f"color must be one of {', '.join(COLORS)} or three numbers, got {color!r}")
        return COLORS[color]
    values = tuple(float(c) for c in color)
    if len(values) != 3 or not all(0 <= c <= 1 for c in values):
        raise ValueError(f"color must be three numbers in [0, 1], got {list(values)}")
    return values[0], values[1], values[2]


class Background(nn.Module, ABC):
    """Colour behind each ray."""

    needs_alpha = False  # whether training needs images with alpha
    variance = 0.0  # of its colours in training, of which it gives the mean
    shows_beyond = False  # whether it is a scene beyond the box: costly, and left out where no light gets through

    @abstractmethod
    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
        """Colours (R, 3) in [0, 1] behind R rays."""

    def constant(self) -> Tensor | None:
        """The colour (3,) that is the same in all directions in evaluation mode; None if there may be several."""
        return None


class ConstantBackground(Background):
    """The same colour everywhere.

    Args:
        color: "white", "black" or three numbers in [0, 1].
    """

    def __init__(self, color: str | Sequence[float] = "white") -> None:
        super().__init__()
        self.color = nn.Buffer(torch.tensor(parse_color(color)), persistent=False)

    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
        """One colour, expanded to (R, 3)."""
        return self.color.to(rays.origins.dtype).expand(len(rays), 3)

    def constant(self) -> Tensor | None:
        """The colour (3,)."""
        return self.color


class RandomBackground(ConstantBackground):
    """Any colour in training, one colour in evaluation.

    A training image with alpha is composited on the same colours, so only true opacity explains it: the
    cure for fields that paint the background's colour into empty space. Nothing is drawn: with colours b uniform in
    [0, 1], errors e of premultiplied colour and a of opacity, the mean of `(e - a b)^2` is `(e - a / 2)^2 + a^2 / 12`,
    the error on grey and the variance times that of opacity. The losses take this mean.

    Args:
        color: colour in evaluation mode.
    """

    needs_alpha = True
    variance = 1 / 12

    def forward(self, rays: Rays, *, generator: torch.Generator | None = None) -> Tensor:
        """The mean colour (R, 3), grey, in training mode, the constant one in evaluation mode."""
        return torch.full_like(rays.origins, 0.5) if self.training else super().forward(rays)

    def constant(self) -> Tensor | None:
        """The colour (3,) of evaluation mode."""
        return self.color
