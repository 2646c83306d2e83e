"""What a step of training looked like, whether its numbers make sense, and when training is looked at and ends."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import nn

from dnerf.core.checks import check_positive, check_whole

OPENING = 0.3  # of progress: by then all frames and levels are in, and rates begin to fall


@dataclass(frozen=True)
class TrainingRecord:
    """What one step of training looked like."""

    step: int  # number of steps done, this one included
    seconds: float  # time spent training so far, see `Trainer`
    losses: Mapping[str, float]  # terms of the step by name, without weights; "loss" is what the step minimised
    psnr: float  # of the batch's colours, in dB; with error-guided pixels of rays that are harder than others
    num_rays: int  # rays of the batch
    num_samples: int  # that its rays were rendered from, padding aside
    learning_rate_factor: float  # on all learning rates, in [0, 1]
    opacity: float  # mean of the batch, in [0, 1]
    contrast: float  # mean over the batch of the largest difference between a true colour and the background, in [0, 1]

    def broken(self) -> list[str]:
        """Names of the losses that are NaN or infinite."""
        return [name for name, value in self.losses.items() if not math.isfinite(value)]


def not_finite(model: nn.Module, *, gradients: bool = False) -> list[str]:
    """Names of the parameters that hold NaN or infinity, or whose gradients do."""
    values = ((name, p.grad if gradients else p) for name, p in model.named_parameters())
    return [name for name, value in values if value is not None and not bool(torch.isfinite(value).all())]


@dataclass(frozen=True)
class Limits:
    """When training ends (None for any), when a record is made, and how many steps an opening has at most; positive."""

    num_steps: int
    max_seconds: float | None
    log_every: int
    opening_steps: int | None = None

    def __post_init__(self) -> None:
        check_whole("num_steps", self.num_steps)
        check_whole("log_every", self.log_every)
        check_whole("opening_steps", 1 if self.opening_steps is None else self.opening_steps)
        if self.max_seconds is not None:
            check_positive("max_seconds", self.max_seconds)

    def progress(self, step: int, seconds: float) -> float:
        """How much of training is over, in [0, 1]: of its steps or of its seconds, whichever is more.

        An opening of so many steps ends at the progress `OPENING`, sooner than that share of a long training.
        """
        of_time = 0.0 if self.max_seconds is None else seconds / self.max_seconds
        done = min(max(step / self.num_steps, of_time), 1.0)
        if self.opening_steps is None or not step:
            return done
        opening = min(OPENING, self.opening_steps * done / step)  # the share that so many steps take
        return OPENING * done / opening if done < opening else 1 - (1 - OPENING) * (1 - done) / (1 - opening)

    def is_finished(self, step: int, seconds: float) -> bool:
        """Whether no step is left, or no time."""
        return step >= self.num_steps or (self.max_seconds is not None and seconds >= self.max_seconds)

    def is_recorded(self, step: int) -> bool:
        """Whether a step has a record, beside the last one."""
        return step == 1 or step % self.log_every == 0
