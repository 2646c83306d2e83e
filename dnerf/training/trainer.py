"""Training a renderer on frames: random rays over all frames, losses, an optimiser, and callbacks around each step."""

import copy
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from signal import Signals
from typing import cast

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_positive, check_whole
from dnerf.data.frames import Frames
from dnerf.data.pixel_samplers import FrameSubset, PixelSampler, UniformPixels
from dnerf.losses import Loss, PhotometricLoss
from dnerf.nn.encodings import FramesAware
from dnerf.rendering.cuda_graphs import GraphCache
from dnerf.rendering.renderer import Renderer, has_fixed_capacity
from dnerf.samplers import Capacity
from dnerf.training.inheritance import take_over
from dnerf.training.optimizer import AdamSettings
from dnerf.training.records import Limits, TrainingRecord, not_finite
from dnerf.training.run import Callback, Run
from dnerf.training.signals import StopRequest, TrainingStopped, stop_requests
from dnerf.training.step import Stepper, next_num_rays, warm_up

logger = logging.getLogger(__name__)


class Trainer:
    """Adam on random rays until `num_steps` or `max_seconds` is reached, whichever comes first.

    Progress p in [0, 1] is the larger of steps done / num_steps and seconds spent / max_seconds, but in a long training
    its first part is sooner over (`opening_steps`). All that changes during training follows it, so a time-limited run
    still ends with a finished schedule. It never falls: what has opened stays open when a run is continued for longer.
    Seconds are those of the steps themselves: loading, compiling kernels and what callbacks do (checkpoints, copies for
    recovery, logs, previews) do not count.

    Args:
        num_steps: most optimiser steps.
        max_seconds: most seconds of training, or None.
        num_rays: rays per step, or the first step's if `target_samples` is given.
        target_samples: that are rendered per step; the number of rays is adapted to it (for samplers that skip empty
            space: rays that meet nothing cost nothing).
        max_rays: bound of the adapted number of rays.
        losses: terms by name; the photometric loss if None.
        pixels: draws the pixels of each step; all alike if None.
        optimizer: rates and how they fall; `AdamSettings()` if None.
        callbacks: by name, called in this order, required ones last (see `Callback`); none if None.
        log_every: steps between records.
        graphs: samples in fixed numbers of places, whatever rays meet, so that on a GPU steps are replayed as CUDA
            graphs. For samplers of `FixedCapacity`, with `target_samples`.
        marched_per_sample: then, intervals in occupied cells for which there are places, per sample.
        opening_steps: by which a progress of 0.3 is reached at the latest, however long training is: until then frames
            and levels come in and rates are high, which wants steps enough, and harms when it lasts. None for any.

    Raises:
        ValueError: for numbers out of range, or parts of another kind.
    """

    def __init__(
        self, *, num_steps: int = 200_000, max_seconds: float | None = None, num_rays: int = 1024,
        target_samples: int | None = None, max_rays: int = 1 << 16, losses: Mapping[str, Loss] | None = None,
        pixels: PixelSampler | None = None, optimizer: AdamSettings | None = None,
        callbacks: Mapping[str, Callback] | None = None, log_every: int = 20, graphs: bool = False,
        marched_per_sample: float = 3.0, opening_steps: int | None = None,
    ) -> None:  # fmt: skip
        target = 1 if target_samples is None else target_samples
        for name, value in (("num_rays", num_rays), ("max_rays", max_rays), ("target_samples", target)):
            check_whole(name, value)
        check_positive("marched_per_sample", marched_per_sample)
        if graphs and target_samples is None:
            raise ValueError("target_samples must be given with graphs, got null")
        self.limits = Limits(num_steps, max_seconds, log_every, opening_steps)
        self.num_rays, self.target_samples, self.max_rays = num_rays, target_samples, max_rays
        self.losses = nn.ModuleDict(_of_kind("losses", {"rgb": PhotometricLoss()} if losses is None else losses, Loss))
        self.pixels = UniformPixels() if pixels is None else pixels
        self.optimizer = AdamSettings() if optimizer is None else optimizer
        _of_kind("trainer", {"pixels": self.pixels}, PixelSampler)
        _of_kind("trainer", {"optimizer": self.optimizer}, AdamSettings)
        made = _of_kind("callbacks", callbacks or {}, Callback)
        self.callbacks: dict[str, Callback] = dict(sorted(made.items(), key=lambda item: item[1].is_required))
        self.graphs, self.marched_per_sample = graphs, marched_per_sample
        self._losses_at_first = copy.deepcopy(self.losses.state_dict())

    def fit(
        self, renderer: Renderer, frames: Frames, *, seed: int = 0, folder: str | Path | None = None,
        resume: bool = False, begun: Run | None = None,
    ) -> TrainingRecord:  # fmt: skip
        """Train in place; the last step's record.

        With a folder, SIGTERM and SIGINT end training after the step they find, and after what callbacks then do.

        Args:
            renderer: the model, on the device where training happens.
            frames: images, cameras and times; moved to the model's device.
            seed: of the random rays, points and backgrounds.
            folder: of the run's files, for callbacks that write some; None for none.
            resume: continue from the newest checkpoint in the folder, if there is one, exactly as if training had never
                stopped; needs a callback that does so, `Checkpoints`.
            begun: a run whose first steps are done already, by a model of the same parts; None for a fresh one.

        Raises:
            FloatingPointError: naming step and tensors, when the loss is not finite.
            ValueError: if a part does not find what it needs, or a checkpoint does not fit.
            TrainingStopped: after a signal.
            MemoryError: saying what to lower, when a GPU's memory does not suffice.
            OSError: if the last checkpoint cannot be written.
        """
        if resume and not any(callback.resumes for callback in self.callbacks.values()):
            given = ", ".join(type(callback).__name__ for callback in self.callbacks.values()) or "none"
            raise ValueError(f"resume=True needs a callback that continues runs, such as Checkpoints, got {given}")
        run = self.begin(renderer, frames, seed=seed)
        if begun is not None:
            take_over(run, begun)
        run.callbacks, run.resume = self.callbacks, resume
        run.folder = None if folder is None else Path(folder)
        for callback in self.callbacks.values():
            callback.on_train_begin(run)
        catching = nullcontext(StopRequest()) if folder is None else stop_requests()
        with catching as request, _advice_on_memory(run):
            self.advance(run, lambda: self.limits.is_finished(run.step, run.seconds), request)
        renderer.set_progress(1.0)
        renderer.eval()
        self._notify("on_train_end", run)
        assert run.last_record is not None
        return run.last_record

    def begin(self, renderer: Renderer, frames: Frames, *, seed: int = 0) -> Run:
        """A run before its first step, without folder and callbacks; arguments and errors as of `fit`."""
        self.losses.load_state_dict(self._losses_at_first, strict=False)  # what they count begins anew, too
        run = Run(
            renderer, frames.to(renderer.device), self.optimizer.build(renderer),
            torch.Generator(renderer.device).manual_seed(seed), self.losses.to(renderer.device),
            self.pixels.to(renderer.device), num_rays=self.num_rays, most_rays=max(self.num_rays, self.max_rays),
        )  # fmt: skip
        self._check(run)
        renderer.train()
        for part in renderer.modules():
            if isinstance(part, FramesAware):
                part.see(run.frames.times, run.frames.poses[:, :3, 3])
        self.pixels.begin(run.frames)
        warm_up(renderer, run.frames)
        return run

    def frames_in(self, progress: float) -> Tensor | None:
        """Numbers (n,) of the frames that pixels are drawn from at a progress in [0, 1]; None for all."""
        return self.pixels.frames_in(progress) if isinstance(self.pixels, FrameSubset) else None

    def advance(self, run: Run, is_done: Callable[[], bool], request: StopRequest | None = None) -> None:
        """Take steps of a run, one of `begin` or `fit`, until `is_done` says so; TrainingStopped after a signal."""
        request = StopRequest() if request is None else request
        stepper = self._stepper(run)
        while not is_done():
            self._turn(run, stepper, request)
            if run.signal and not run.ends:
                saved = "all" if any(x.is_required for x in run.callbacks.values()) else "nothing"
                said = f"stopped by {Signals(run.signal).name} after step {run.step}, {saved} saved"
                raise TrainingStopped(run.signal, said)

    def _check(self, run: Run) -> None:
        """Raise unless every part finds what it needs."""
        if run.renderer.background.needs_alpha and not run.frames.is_transparent:
            raise ValueError("background: a random one needs frames with alpha, these have none")
        if self.graphs and not has_fixed_capacity(run.renderer.sampler):
            raise ValueError(f"graphs needs a sampler of fixed capacity, got {type(run.renderer.sampler).__name__}")
        for name, loss in self.losses.items():
            try:
                cast(Loss, loss).check(run.renderer)
            except ValueError as error:
                raise ValueError(f"losses.{name}: {error}; leave it out") from error

    def _stepper(self, run: Run) -> Stepper:
        """What takes steps; it replays them where sizes are fixed."""
        capacity, graphs = None, None
        if self.graphs and self.target_samples is not None:
            capacity = Capacity(int(self.marched_per_sample * self.target_samples), self.target_samples)
            run.optimizer.make_capturable()
            graphs = GraphCache(run.renderer.device, [run.generator], list(run.renderer.parameters()))
        return Stepper(run, capacity, graphs)

    def _turn(self, run: Run, stepper: Stepper, request: StopRequest) -> None:
        """One step, and what callbacks do around it."""
        self._notify("on_step_begin", run)
        begin = time.perf_counter()
        num_rays = run.num_rays
        run.progress = max(run.progress, self.limits.progress(run.step, run.seconds))
        run.renderer.set_progress(run.progress)
        factor = self.optimizer.factor(run.step, run.progress)
        run.optimizer.set_rates(factor * run.rate_factor)
        stepper.update()
        drawn = self.pixels.draw(num_rays, run.progress, run.generator)
        indices = run.frames.counted(drawn)
        result = stepper(indices)
        self.pixels.feedback(drawn, torch.where(indices == drawn, result.errors, 0))  # what does not count is right
        if run.renderer.device.type == "cuda" and self.limits.is_recorded(run.step + 1):
            torch.cuda.synchronize(run.renderer.device)  # looking stops the clock, not what is still at work
        run.seconds += time.perf_counter() - begin
        run.signal = request.number
        run.step += 1
        run.rays_done += num_rays
        if self.target_samples is not None:
            target, most = self.target_samples, self.max_rays
            run.num_rays = next_num_rays(num_rays, result.num_samples, target, most, run.step, is_fixed=self.graphs)
        run.ends = self.limits.is_finished(run.step, run.seconds)
        record = None
        if run.ends or run.signal or self.limits.is_recorded(run.step):
            scalars = {name: float(value) for name, value in result.scalars.items()}  # waits for the device
            record = self._record(run, scalars, num_rays, result.num_samples, factor)
        run.set_record(record)
        self._notify("on_step_end", run)

    def _notify(self, event: str, run: Run) -> None:
        """Call all callbacks; one that cannot write loses its output, and the run only if it is required."""
        for callback in run.callbacks.values():
            try:
                getattr(callback, event)(run)
            except OSError as error:
                if callback.is_required:
                    raise
                logger.warning("step %d: %s failed: %s", run.step, type(callback).__name__, error)

    def _record(self, run: Run, numbers: dict[str, float], rays: int, samples: int, factor: float) -> TrainingRecord:
        """A step's record; FloatingPointError for losses that are not finite, if no callback handles that."""
        mse, opacity, contrast = (numbers.pop(name) for name in ("mse", "opacity", "contrast"))
        psnr = -10 * math.log10(max(mse, 1e-12))
        record = TrainingRecord(run.step, run.seconds, numbers, psnr, rays, samples, factor, opacity, contrast)
        if (broken := record.broken()) and not any(callback.handles_failures for callback in run.callbacks.values()):
            parameters, losses = ", ".join(not_finite(run.renderer)) or "none", ", ".join(broken)
            raise FloatingPointError(f"step {run.step}: {losses} not finite; parameters not finite: {parameters}")
        return record


def _of_kind(what: str, parts: Mapping[str, object], kind: type) -> dict:
    """The parts, but for those that are None; ValueError, naming it, for one of another kind."""
    if not isinstance(parts, Mapping):
        raise ValueError(f"{what} must hold parts by name, got {parts!r}")
    for name, part in parts.items():
        if part is not None and not isinstance(part, kind):
            raise ValueError(f"{what}.{name} must be of {kind.__name__} or null, got {part!r}")
    return {name: part for name, part in parts.items() if part is not None}


@contextmanager
def _advice_on_memory(run: Run) -> Iterator[None]:
    """Turn a GPU's lack of memory within a `with` block into an error that says what to lower."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise MemoryError(
            f"step {run.step + 1}: the GPU's memory does not suffice for {run.num_rays} rays; lower trainer.num_rays, "
            "trainer.target_samples or trainer.max_rays, or set renderer.precision=bfloat16; a checkpoint, if there "
            f"is one, is good ({' '.join(str(error).split())[:120]})"
        ) from error
