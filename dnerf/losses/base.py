"""What a loss is: one term, a rendering of a batch and the model in, one number out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn

from dnerf.core.checks import check_positive, check_whole
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Schedule
from dnerf.rendering.renderer import Renderer


@dataclass(frozen=True)
class Batch:
    """What a step learns from."""

    rgba: Tensor  # (R, 4) true colours, premultiplied; alpha is 1 where images have none
    target: Tensor  # (R, 3) true colours on the rendering's background


class Loss(nn.Module, ABC):
    """One term of what training minimises; the trainer multiplies it by its weight.

    Args:
        weight: factor of the term, a number >= 0 or a schedule.
        every: n: the term takes part in every n-th step and counts n times there, which costs less and means the same
            on average.

    Raises:
        ValueError: for a negative weight, or steps that are no whole number above 0.
    """

    def __init__(self, weight: float | Schedule = 1.0, *, every: int = 1) -> None:
        super().__init__()
        if not isinstance(weight, Schedule):
            check_positive("weight", weight, allow_zero=True)
        check_whole("every", every)
        self.weight = weight
        self.every = every

    @abstractmethod
    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """The term, a scalar, without its weight.

        Args:
            rendering: of the batch's R rays, with per-sample data.
            batch: what they should have shown.
            model: the renderer, for terms about its parameters or its field.
        """

    def check(self, model: Renderer) -> None:
        """Raise ValueError, before training begins, if the model lacks what this term needs; none by default."""
