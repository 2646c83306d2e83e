"""What a step of training looked like: its numbers, whether they make sense, and one line for the eye."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from tqdm import tqdm

from dnerf.renderer import Renderer

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingRecord:
    """What one step of training looked like.

    Args:
        step: number of steps done, this one included.
        seconds: time spent training so far, callbacks and data loading left out.
        losses: each loss term of the step by name; "loss" is what it minimised, see `Trainer`'s `loss_every`.
        psnr: of the batch's colours, in dB; with an error map of rays that are harder than others.
        num_rays: rays of the batch.
        num_samples: that its rays were rendered from, padding aside.
        learning_rate_factor: of the schedule, in [0, 1].
    """

    step: int
    seconds: float
    losses: Mapping[str, float]
    psnr: float
    num_rays: int
    num_samples: int
    learning_rate_factor: float


@dataclass(frozen=True)
class Outcome:
    """What one process finds in a step.

    Args:
        scalars: loss terms, "loss" and "mse", on the device.
        weight: of this process's share of the rays in the mean over processes.
        num_samples: that the share was rendered from, padding aside.
        learning_rate_factor: of the schedule, in [0, 1].
    """

    scalars: Mapping[str, Tensor]
    weight: float
    num_samples: int
    learning_rate_factor: float

    def numbers(self) -> dict[str, float]:
        """The scalars, weighted; this waits for the device."""
        return {name: float(value) * self.weight for name, value in self.scalars.items()}


def show(bar: tqdm, record: TrainingRecord, progress: float, rays_done: int) -> None:
    """Bring a progress bar up to date."""
    remaining = record.seconds * (1 - progress) / max(progress, 1e-9)
    bar.n = round(100 * progress, 1)
    bar.set_postfix_str(
        f"step {record.step:,}, loss {record.losses['loss']:.4f}, PSNR {record.psnr:.2f} dB, "
        f"{rays_done / record.seconds:,.0f} rays/s, ETA {remaining:.0f} s"
    )


def psnr_of(mse: float) -> float:
    """PSNR in dB of colours in [0, 1] with a mean squared error, at most 120."""
    return -10 * math.log10(max(mse, 1e-12))


def check_finite(numbers: Mapping[str, float], step: int, renderer: nn.Module) -> None:
    """Stop a training that has broken.

    Raises:
        FloatingPointError: naming the step, the numbers and the parameters that are not finite.
    """
    broken = [name for name, value in numbers.items() if not math.isfinite(value)]
    if broken:
        parameters = ", ".join(not_finite(renderer)) or "none"
        raise FloatingPointError(f"step {step}: {', '.join(broken)} not finite; parameters not finite: {parameters}")


def not_finite(renderer: nn.Module) -> list[str]:
    """Names of the parameters that hold NaN or infinity."""
    return [name for name, p in renderer.named_parameters() if not bool(torch.isfinite(p).all())]


Callback = Callable[[TrainingRecord, Renderer], None]


def report(record: TrainingRecord, renderer: Renderer, callbacks: Sequence[Callback]) -> None:
    """Call the callbacks; one that cannot write (a full disk) costs its output, not the run."""
    for callback in callbacks:
        try:
            callback(record, renderer)
        except OSError as error:
            logger.warning("step %d: %s failed: %s", record.step, type(callback).__name__, error)
