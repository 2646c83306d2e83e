"""Training a renderer on frames: random rays over all frames, Adam, schedules that follow steps and seconds."""

import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from tqdm import tqdm

from dnerf.backgrounds import RandomBackground
from dnerf.checks import check_choice, check_positive
from dnerf.data.frames import Frames, composite_on
from dnerf.losses import Loss, PhotometricLoss
from dnerf.recovery import Recovery
from dnerf.renderer import Renderer

logger = logging.getLogger(__name__)

BAR = "{percentage:3.0f}% |{bar}| {elapsed}{postfix}"
SCHEDULES = ("exponential", "cosine", "constant")


@dataclass(frozen=True)
class TrainingRecord:
    """What one step of training looked like.

    Args:
        step: number of steps done, this one included.
        seconds: time spent training so far, callbacks and data loading left out.
        losses: each loss term by name; "loss" is their sum.
        psnr: of the batch's colours, in dB.
        num_rays: rays of the batch.
        num_samples: field evaluations of the batch.
        learning_rate_factor: of the schedule, in [0, 1].
    """

    step: int
    seconds: float
    losses: Mapping[str, float]
    psnr: float
    num_rays: int
    num_samples: int
    learning_rate_factor: float


Callback = Callable[[TrainingRecord, Renderer], None]


class Trainer:
    """Adam on random rays until `num_steps` or `max_seconds` is reached, whichever comes first.

    Progress p in [0, 1] is the larger of steps done / num_steps and seconds spent / max_seconds; learning rates and
    encoding windows follow it, so a time-limited run still ends with a finished schedule.

    Args:
        num_steps: most optimiser steps.
        max_seconds: most seconds of training, or None; loading, compiling kernels and callbacks do not count.
        num_rays: rays per step, or the first step's if `target_samples` is given.
        target_samples: field evaluations per step; the number of rays is adapted to it (for samplers that skip empty
            space: rays that meet nothing cost nothing).
        max_rays: bound of the adapted number of rays.
        learning_rates: by parameter-name prefix of the renderer ("" is the default, the longest match wins); one that
            matches nothing is ignored, so that one set serves models with and without a part.
        schedule: "exponential", "cosine" or "constant".
        final_learning_rate: factor at the end of the schedule.
        warmup_steps: steps over which the factor rises linearly from near zero.
        betas: Adam's moment decay rates.
        epsilon: Adam's epsilon.
        losses: terms by name; the photometric loss if None.
        log_every: steps between records.
        progress_bar: whether to draw one on standard error.
        recovery: brings a run back that goes to NaN or collapses; None lets it end with an error.

    Raises:
        ValueError: for numbers out of range, or learning rates without a default.
    """

    def __init__(
        self,
        *,
        num_steps: int = 20000,
        max_seconds: float | None = None,
        num_rays: int = 1024,
        target_samples: int | None = None,
        max_rays: int = 1 << 16,
        learning_rates: Mapping[str, float] | None = None,
        schedule: str = "exponential",
        final_learning_rate: float = 0.1,
        warmup_steps: int = 0,
        betas: Sequence[float] = (0.9, 0.999),
        epsilon: float = 1e-8,
        losses: Mapping[str, Loss] | None = None,
        log_every: int = 20,
        progress_bar: bool = True,
        recovery: Recovery | None = None,
    ) -> None:
        for name, value in (
            ("num_steps", num_steps),
            ("num_rays", num_rays),
            ("max_rays", max_rays),
            ("final_learning_rate", final_learning_rate),
            ("log_every", log_every),
            ("max_seconds", 1 if max_seconds is None else max_seconds),
            ("target_samples", 1 if target_samples is None else target_samples),
        ):
            check_positive(name, value)
        check_choice("schedule", schedule, SCHEDULES)
        self.num_steps = num_steps
        self.max_seconds = max_seconds
        self.num_rays = num_rays
        self.target_samples = target_samples
        self.max_rays = max_rays
        self.learning_rates = {"": 5e-4} if learning_rates is None else dict(learning_rates)
        if "" not in self.learning_rates:
            raise ValueError(f"learning_rates must have a default under '', got {self.learning_rates}")
        self.schedule = schedule
        self.final_learning_rate = final_learning_rate
        self.warmup_steps = warmup_steps
        self.betas = (betas[0], betas[1])
        self.epsilon = epsilon
        self.losses = nn.ModuleDict({"rgb": PhotometricLoss()} if losses is None else dict(losses))
        self.log_every = log_every
        self.progress_bar = progress_bar
        self.recovery = recovery

    def fit(
        self, renderer: Renderer, frames: Frames, *, seed: int = 0, callbacks: Sequence[Callback] = ()
    ) -> TrainingRecord:
        """Train in place.

        Args:
            renderer: the model, on the device where training happens.
            frames: pictures, cameras and times; moved to the model's device.
            seed: of the random rays, points and backgrounds.
            callbacks: called with every record, the clock stopped.

        Returns:
            The last step's record.

        Raises:
            FloatingPointError: naming step and tensors, when the loss is not finite.
            ValueError: if frames have no alpha but a random background needs it.
        """
        if isinstance(renderer.background, RandomBackground) and not frames.has_alpha:
            raise ValueError("background: a random one needs frames with alpha, these have none")
        device = renderer.device
        frames = frames.to(device)
        generator = torch.Generator(device).manual_seed(seed)
        optimizer = self._optimizer(renderer)
        base_rates = [group["lr"] for group in optimizer.param_groups]
        num_rays, seconds, step, progress, rays_done = self.num_rays, 0.0, 0, 0.0, 0
        if self.recovery is not None:
            self.recovery.begin()
        renderer.train()
        self._warm_up(renderer, frames)
        with tqdm(total=100, disable=not self.progress_bar, dynamic_ncols=True, bar_format=BAR) as bar:
            while True:
                begin = time.perf_counter()
                renderer.set_progress(progress)
                factor = self._learning_rate_factor(progress, step)
                for group, rate in zip(optimizer.param_groups, base_rates):
                    group["lr"] = rate * factor * (1.0 if self.recovery is None else self.recovery.factor)
                renderer.update(step)
                terms, num_samples, mse = self._step(renderer, frames, optimizer, num_rays, generator)
                step += 1
                used_rays, num_rays = num_rays, self._next_num_rays(num_rays, num_samples)
                rays_done += used_rays
                done = step >= self.num_steps
                is_record = step == 1 or step % self.log_every == 0
                seconds += time.perf_counter() - begin
                done = done or (self.max_seconds is not None and seconds >= self.max_seconds)
                progress = self._progress(step, seconds)
                if is_record or done:
                    values = {name: float(term) for name, term in terms.items()}
                    record = TrainingRecord(step, seconds, values, _psnr(float(mse)), used_rays, num_samples, factor)
                    failed = self.recovery is not None and self.recovery.check(step, renderer, optimizer, values)
                    if not failed:
                        _check_finite(values, step, renderer)
                        for callback in callbacks:
                            callback(record, renderer)
                        _show(bar, record, progress, rays_done)
                if done:
                    break
        renderer.set_progress(1.0)
        renderer.eval()
        return record

    def _warm_up(self, renderer: Renderer, frames: Frames) -> None:
        """Run every kernel once, forward and backward, so that their compilation is not timed.

        No parameter changes; a sampler that observes sees the untrained field at a few points.
        """
        generator = torch.Generator(frames.images.device).manual_seed(0)
        indices = torch.randint(frames.num_pixels, (64,), generator=generator, device=generator.device)
        loss = renderer(frames.pixels(indices)[0], generator=generator).rgb.sum()
        if loss.requires_grad:
            loss.backward()
        renderer.zero_grad(set_to_none=True)

    def _step(
        self,
        renderer: Renderer,
        frames: Frames,
        optimizer: torch.optim.Optimizer,
        num_rays: int,
        generator: torch.Generator,
    ) -> tuple[dict[str, Tensor], int, Tensor]:
        indices = torch.randint(frames.num_pixels, (num_rays,), generator=generator, device=generator.device)
        rays, rgba = frames.pixels(indices)
        rendering = renderer(rays, generator=generator)
        assert rendering.background is not None
        assert rendering.samples is not None
        target = composite_on(rgba, rendering.background)
        if self.recovery is not None:
            self.recovery.observe(rendering, target)
        terms = {name: loss(rendering, target, renderer) for name, loss in self.losses.items()}
        total = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        if total.requires_grad:
            total.backward()
            optimizer.step()
        mse = (rendering.rgb.detach() - target).square().mean()
        detached = {name: term.detach() for name, term in terms.items()}
        return {"loss": total.detach(), **detached}, rendering.samples.starts.numel(), mse

    def _optimizer(self, renderer: Renderer) -> torch.optim.Optimizer:
        groups: dict[str, list[nn.Parameter]] = {prefix: [] for prefix in self.learning_rates}
        for name, parameter in renderer.named_parameters():
            prefix = max((p for p in groups if name.startswith(p)), key=len)
            groups[prefix].append(parameter)
        listed = [{"params": parameters, "lr": self.learning_rates[prefix]} for prefix, parameters in groups.items()]
        return torch.optim.Adam([g for g in listed if g["params"]], betas=self.betas, eps=self.epsilon, fused=True)

    def _next_num_rays(self, num_rays: int, num_samples: int) -> int:
        if self.target_samples is None:
            return num_rays
        wanted = num_rays * self.target_samples / max(num_samples, 1)
        return int(min(max(wanted, num_rays / 2, 1), num_rays * 2, self.max_rays))

    def _progress(self, step: int, seconds: float) -> float:
        of_time = 0.0 if self.max_seconds is None else seconds / self.max_seconds
        return min(max(step / self.num_steps, of_time), 1.0)

    def _learning_rate_factor(self, progress: float, step: int) -> float:
        warmup = min(1.0, (step + 1) / (self.warmup_steps + 1))
        if self.schedule == "exponential":
            return warmup * self.final_learning_rate**progress
        if self.schedule == "cosine":
            cosine = 0.5 * (1 + math.cos(math.pi * progress))
            return warmup * (self.final_learning_rate + (1 - self.final_learning_rate) * cosine)
        return warmup


def _show(bar: tqdm, record: TrainingRecord, progress: float, rays_done: int) -> None:
    remaining = record.seconds * (1 - progress) / max(progress, 1e-9)
    bar.n = round(100 * progress, 1)
    bar.set_postfix_str(
        f"step {record.step:,}, loss {record.losses['loss']:.4f}, PSNR {record.psnr:.2f} dB, "
        f"{rays_done / record.seconds:,.0f} rays/s, ETA {remaining:.0f} s"
    )


def _psnr(mse: float) -> float:
    return -10 * math.log10(max(mse, 1e-12))


def _check_finite(values: Mapping[str, float], step: int, renderer: nn.Module) -> None:
    if all(math.isfinite(value) for value in values.values()):
        return
    broken = [name for name, value in values.items() if not math.isfinite(value)]
    parameters = [name for name, p in renderer.named_parameters() if not bool(torch.isfinite(p).all())]
    raise FloatingPointError(
        f"step {step}: {', '.join(broken)} not finite; parameters not finite: {', '.join(parameters) or 'none'}"
    )
