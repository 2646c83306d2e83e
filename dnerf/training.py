"""Training a renderer on frames: random rays over all frames, Adam, schedules that follow steps and seconds."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import cast

import torch
from torch import nn
from tqdm import tqdm

from dnerf.backgrounds import RandomBackground
from dnerf.body_search import BodySearch
from dnerf.box_check import BoxCheck
from dnerf.checks import check_choice, check_mapping, check_positive, check_whole
from dnerf.data.frames import Frames
from dnerf.distributed import Processes
from dnerf.encodings import TimeEncoding
from dnerf.error_map import ErrorMap, draw_pixels
from dnerf.graphs import GraphCache
from dnerf.limits import Limits
from dnerf.losses import Loss, PhotometricLoss
from dnerf.missing_matter import LACKING, NEEDED, MissingMatterCheck
from dnerf.optimizers import SCHEDULES, AdamMuon, rate_factor
from dnerf.records import Callback, Outcome, TrainingRecord
from dnerf.recovery import Recovery
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder, RunState, advice_on_memory, fingerprint, max_bytes
from dnerf.silhouettes import most_shown_time
from dnerf.steps import Steps, next_num_rays, warm_up
from dnerf.stopping import StopRequest, stop_requests
from dnerf.time_window import TimeWindow
from dnerf.training_loop import TrainingLoop

logger = logging.getLogger(__name__)

BAR = "{percentage:3.0f}% |{bar}| {elapsed}{postfix}"


class Trainer:
    """Adam on random rays until `num_steps` or `max_seconds` is reached, whichever comes first.

    Progress p in [0, 1] is the larger of steps done / num_steps and seconds spent / max_seconds (counted from the first
    step, if some were spent before); learning rates and encoding windows follow it, so a time-limited run still ends
    with a finished schedule.

    Args:
        num_steps: most optimiser steps.
        max_seconds: most seconds of training, or None; loading, compiling kernels and callbacks do not count.
        num_rays: rays per step, or the first step's if `target_samples` is given.
        target_samples: that are rendered per step; the number of rays is adapted to it (for samplers that skip empty
            space: rays that meet nothing cost nothing).
        max_rays: bound of the adapted number of rays.
        learning_rates: by parameter-name prefix of the renderer, in which * stands for anything ("" is the default, the
            longest match wins); one that matches nothing is ignored, so that one set serves models with and without a
            part.
        schedule: "exponential", "cosine" or "constant".
        final_learning_rate: factor at the end of the schedule.
        warmup_steps: steps over which the factor rises linearly from near zero.
        betas: Adam's moment decay rates.
        epsilon: Adam's epsilon.
        orthogonal: parameter-name prefixes of the renderer below which the weight matrices of networks (those of 16
            rows and columns or more) take orthogonalised steps, see `AdamMuon`.
        graphs: samples in fixed numbers of places, whatever rays meet, so that on a GPU the steps of one process are
            replayed as CUDA graphs, without Python between their kernels. For samplers that can, with `target_samples`.
        marched_per_sample: then, intervals in occupied cells for which there are places, per sample.
        losses: terms by name; the photometric loss if None.
        loss_every: by name of a term, n: it is asked on every n-th step and counts n times there, which costs less and
            means the same on average; names that are none are ignored, others take part in every step.
        time_window: lets frames in by time as training goes on, and holds learning rates until all are in; None for
            all from the start.
        error_map: draws a share of the rays where pictures are wrong; None draws all evenly.
        missing_matter: lets waiting space-time volumes of the field join where motion does not explain the pictures;
            None leaves them waiting.
        body_search: finds small bodies that are too fast for the deformation, once, with what the error map knows; for
            fields that can carry them. None, or no error map, does not look.
        log_every: steps between records.
        checkpoint_every: steps between checkpoints, where they are asked for; None writes one at the end only.
        progress_bar: whether to draw one on standard error.
        recovery: brings a run back that goes to NaN or collapses; None lets it end with an error.
        box_check: ends training by `BoxTooLarge` early on, if matter fills a small part of the box; None never does.

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
        orthogonal: Sequence[str] = (),
        graphs: bool = False,
        marched_per_sample: float = 3.0,
        losses: Mapping[str, Loss] | None = None,
        loss_every: Mapping[str, int] | None = None,
        time_window: TimeWindow | None = None,
        error_map: ErrorMap | None = None,
        missing_matter: MissingMatterCheck | None = None,
        body_search: BodySearch | None = None,
        log_every: int = 20,
        checkpoint_every: int | None = 1000,
        progress_bar: bool = True,
        recovery: Recovery | None = None,
        box_check: BoxCheck | None = None,
    ) -> None:
        check_mapping("learning_rates", learning_rates or {}, allow_zero=True)
        check_mapping("loss_every", loss_every or {})
        target = 1 if target_samples is None else target_samples
        for name, value in (("num_rays", num_rays), ("max_rays", max_rays), ("target_samples", target)):
            check_whole(name, value)
        check_whole("warmup_steps", warmup_steps, allow_zero=True)
        check_positive("final_learning_rate", final_learning_rate)
        check_positive("marched_per_sample", marched_per_sample)
        check_positive("epsilon", epsilon, allow_zero=True)
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas!r}")
        if isinstance(orthogonal, str):
            raise ValueError(f"orthogonal must be a list of names' beginnings, got {orthogonal!r}")
        check_choice("schedule", schedule, SCHEDULES)
        for name, every in (loss_every or {}).items():
            check_whole(f"loss_every.{name}", every)
        kinds = (
            ("time_window", time_window, TimeWindow),
            ("error_map", error_map, ErrorMap),
            ("missing_matter", missing_matter, MissingMatterCheck),
            ("body_search", body_search, BodySearch),
            ("recovery", recovery, Recovery),
            ("box_check", box_check, BoxCheck),
        )
        for name, part, kind in kinds:
            if part is not None and not isinstance(part, kind):
                raise ValueError(
                    f"{name} must be of {kind.__name__} or null, got {part!r} (+trainer/{name}=... adds one)"
                )
        if graphs and target_samples is None:
            raise ValueError("target_samples must be given with graphs, got null")
        self.limits = Limits(num_steps, max_seconds, log_every, checkpoint_every)
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
        self.orthogonal = tuple(orthogonal)
        self.graphs = graphs
        self.marched_per_sample = marched_per_sample
        self.losses = nn.ModuleDict({"rgb": PhotometricLoss()} if losses is None else dict(losses))
        self.loss_every = dict(loss_every or {})
        self.time_window = time_window
        self.error_map = error_map
        self.missing_matter = missing_matter
        self.body_search = body_search
        self.progress_bar = progress_bar
        self.recovery = recovery
        self.box_check = box_check

    def fit(
        self,
        renderer: Renderer,
        frames: Frames,
        *,
        seed: int = 0,
        callbacks: Sequence[Callback] = (),
        checkpoints: CheckpointFolder | None = None,
        resume: bool = False,
        processes: Processes | None = None,
        seconds: float = 0.0,
    ) -> TrainingRecord:
        """Train in place.

        With `checkpoints`, SIGTERM and SIGINT end training after the step they find, its state saved.

        Args:
            renderer: the model, on the device where training happens.
            frames: pictures, cameras and times; moved to the model's device.
            seed: of the random rays, points and backgrounds.
            callbacks: called with every record, the clock stopped; in the first process only.
            checkpoints: where states are written every `checkpoint_every` steps and at the end, or None.
            resume: continue from the newest checkpoint, if there is one, exactly as if training had never stopped.
            processes: those that train together; None for this one alone.
            seconds: of `max_seconds`, less than it, that were spent before the first step; a checkpoint knows its own.

        Returns:
            The last step's record.

        Raises:
            FloatingPointError: naming step and tensors, when the loss is not finite.
            ValueError: if frames have no alpha but a random background needs it, no second is left, or a checkpoint
                does not fit.
            TrainingStopped: after a signal.
            BoxTooLarge: if `box_check` finds so; the model is of no more use, and neither are its checkpoints.
            MemoryError: saying what to lower, when a GPU's memory does not suffice.
            OSError: if the last checkpoint cannot be written; for earlier ones a warning is logged.
        """
        if isinstance(renderer.background, RandomBackground) and not frames.has_alpha:
            raise ValueError("background: a random one needs frames with alpha, these have none")
        if self.limits.max_seconds is not None and not 0 <= seconds < self.limits.max_seconds:
            raise ValueError(f"seconds must be in [0, max_seconds) = [0, {self.limits.max_seconds}), got {seconds}")
        processes = processes or Processes()
        frames = frames.to(renderer.device)
        generator = torch.Generator(renderer.device).manual_seed(seed)
        modules: dict[str, nn.Module] = {"renderer": renderer, "losses": self.losses}
        if self.time_window is not None and not self.time_window.is_given:
            self.time_window.open_around(most_shown_time(frames))
        if self.error_map is not None:
            self.error_map.begin(frames)
            modules["error_map"] = self.error_map
        run = RunState(modules, self.optimizer(renderer), generator, max(self.num_rays, processes.size))
        run.seconds = run.begun = float(seconds)
        if checkpoints is not None:
            run.data = fingerprint(frames)
        renderer.train()
        for part in renderer.modules():
            if isinstance(part, TimeEncoding):
                part.see(frames.times)
        places = self._places(processes)
        renderer.sampler.fix_sizes(None if places is None else int(self.marched_per_sample * places), places)
        warm_up(renderer, frames)
        if resume and checkpoints is not None:
            self._restore(run, checkpoints, processes)
        if self.recovery is not None:
            self.recovery.begin(run.rollbacks)
        catching = nullcontext(StopRequest()) if checkpoints is None else stop_requests()
        is_shown = self.progress_bar and processes.is_first
        bar = tqdm(total=100, disable=not is_shown, dynamic_ncols=True, bar_format=BAR)
        with bar, catching as request, processes.watched(), advice_on_memory(run):
            steps = self._steps(run, renderer, processes.wrap(renderer), frames, processes)
            loop = TrainingLoop(
                run, renderer, processes,
                limits=self.limits, recovery=self.recovery, callbacks=callbacks, checkpoints=checkpoints,
                request=request, bar=bar,
            )  # fmt: skip
            loop.go(steps, lambda: self._step(run, renderer, steps, processes), lambda n: self._next_rays(run, n))
        if places is not None:
            renderer.sampler.fix_sizes(None)
        renderer.set_progress(1.0)
        renderer.eval()
        if self.body_search is not None:
            self.body_search.finish(renderer)
        if self.box_check is not None and processes.is_first:
            self.box_check.warn(run.step, renderer, frames)
        assert run.record is not None
        return TrainingRecord(**run.record)

    def optimizer(self, renderer: Renderer) -> AdamMuon:
        """A fresh optimiser of the model's parameters."""
        return AdamMuon.of(
            renderer, self.learning_rates, orthogonal=self.orthogonal, betas=self.betas, eps=self.epsilon
        )

    def _places(self, processes: Processes) -> int | None:
        """Places that each process has for samples, if their number is fixed."""
        return -(-self.target_samples // processes.size) if self.graphs and self.target_samples is not None else None

    def _steps(
        self, run: RunState, renderer: Renderer, model: nn.Module, frames: Frames, processes: Processes
    ) -> Steps:
        """What takes steps; it replays them where sizes are fixed, unless processes train together."""
        graphs = None
        if self.graphs and processes.size == 1:
            run.optimizer.make_capturable()
            graphs = GraphCache(renderer.device, [run.generator], list(renderer.parameters()))
        return Steps(
            model, renderer, frames, run.optimizer, run.generator,
            losses=dict(self.losses.items()),
            loss_every=self.loss_every, shows=self.recovery is not None, lacks=self.missing_matter is not None,
            fixed=self._places(processes), graphs=graphs,
        )  # fmt: skip

    def _step(self, run: RunState, renderer: Renderer, steps: Steps, processes: Processes) -> Outcome:
        """One optimiser step on this process's share of a random batch."""
        progress, frames = self.limits.progress(run.step, run.seconds, run.begun), steps.frames
        renderer.set_progress(progress)
        for loss in self.losses.values():
            cast(Loss, loss).set_progress(progress)
        cooling = progress if self.time_window is None else self.time_window.since_open(progress)
        factor = rate_factor(self.schedule, self.final_learning_rate, self.warmup_steps, cooling, run.step)
        run.optimizer.set_rates(factor * (1.0 if self.recovery is None else self.recovery.factor))
        processes.merge_observations(renderer, run.step)
        steps.update(run.step)
        if self.box_check is not None:
            seen = run.step if self.time_window is None else self.time_window.steps_since_open(run.step, progress)
            self.box_check(
                run.step, run.seconds, renderer, frames, max_seconds=self.limits.max_seconds, with_all_frames=seen
            )
        generator, num_rays = run.generator, run.num_rays
        drawn = draw_pixels(frames, num_rays, progress, self.time_window, self.error_map, generator=generator)
        share = processes.share(num_rays)
        indices = drawn[share]
        evenly = num_rays if self.error_map is None else self.error_map.num_even(num_rays)
        # Shares may differ by a ray: weighted so, their mean is that over all rays.
        weight = len(indices) * processes.size / num_rays
        scalars, errors, num_samples = steps(
            indices, run.step + 1, weight, lambda: processes.same_randomness(generator, num_rays),
            num_even=min(max(evenly - share.start, 0), len(indices)),
        )  # fmt: skip
        if self.error_map is not None:
            self.error_map.learn(drawn, processes.all_rays(errors, num_rays))
        lacking = {name: scalars.pop(name) for name in (NEEDED, LACKING) if name in scalars}
        all_in = self.time_window is None or progress >= self.time_window.end
        search, error_map = self.body_search, self.error_map
        if search is not None and error_map is not None and all_in and search.is_due(run.step + 1, progress, renderer):
            found_some = search(run.step + 1, renderer, frames, error_map)
            if found_some:
                steps.forget()
        check = self.missing_matter
        if check is not None and all_in and check.is_due(run.step + 1, progress):
            found = processes.mean({name: float(value) * weight for name, value in lacking.items()})
            if check(run.step + 1, renderer, found):
                steps.forget()
        return Outcome(scalars, weight, num_samples, factor)

    def _next_rays(self, run: RunState, num_samples: int) -> int:
        if self.target_samples is None:
            return run.num_rays
        return next_num_rays(
            run.num_rays, num_samples, self.target_samples, self.max_rays, is_fixed=self.graphs, step=run.step
        )

    def _restore(self, run: RunState, checkpoints: CheckpointFolder, processes: Processes) -> None:
        data = processes.from_first(lambda: checkpoints.read(max_bytes(run.modules)))
        if data is not None:
            run.restore(data, checkpoints.folder, max_rays=max(self.num_rays, self.max_rays))
            run.num_rays = max(run.num_rays, processes.size)
            logger.info("continuing after step %d", run.step)
