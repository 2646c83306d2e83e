"""Steps, records and checkpoints until the end of a training, or a signal."""

import time
from collections.abc import Callable, Sequence
from signal import Signals

import torch
from tqdm import tqdm

from dnerf.distributed import Processes
from dnerf.limits import Limits
from dnerf.records import Callback, Outcome, TrainingRecord, check_finite, psnr_of, report, show
from dnerf.recovery import SHOWN, Recovery
from dnerf.renderer import Renderer
from dnerf.run_state import CheckpointFolder, RunState
from dnerf.steps import Steps
from dnerf.stopping import StopRequest, TrainingStopped


class TrainingLoop:
    """What happens around the steps of one run; every process takes the same turns.

    Args:
        run: where it stands, kept up to date.
        renderer: the model that is trained.
        processes: those that train together.
        limits: when the run ends, is looked at, is saved.
        recovery: brings a broken run back; None lets it end with an error.
        callbacks: called with every record, the clock stopped; in the first process only.
        checkpoints: where states are written, or None.
        request: of a signal to stop.
        bar: the progress bar.
    """

    def __init__(
        self,
        run: RunState,
        renderer: Renderer,
        processes: Processes,
        *,
        limits: Limits,
        recovery: Recovery | None,
        callbacks: Sequence[Callback],
        checkpoints: CheckpointFolder | None,
        request: StopRequest,
        bar: tqdm,
    ) -> None:
        self.run = run
        self.renderer = renderer
        self.processes = processes
        self.limits = limits
        self.recovery = recovery
        self.callbacks = callbacks
        self.checkpoints = checkpoints
        self.request = request
        self.bar = bar

    def go(self, steps: Steps, take: Callable[[], Outcome], next_rays: Callable[[int], int]) -> None:
        """Take steps until the end.

        Args:
            steps: which `take` takes; they are recorded anew when the run has been brought back.
            take: takes one.
            next_rays: of the samples that the latest step took in all processes: how many rays the next one wants.

        Raises:
            FloatingPointError: naming step and tensors, when the loss is not finite.
            TrainingStopped: after a signal, the state saved.
        """
        run, limits, processes = self.run, self.limits, self.processes
        while not limits.is_finished(run.step, run.seconds):
            begin = time.perf_counter()
            outcome = take()
            if self.renderer.device.type == "cuda" and limits.is_looked_at(run.step + 1):
                torch.cuda.synchronize(self.renderer.device)  # looking stops the clock, not what is still at work
            seconds = run.seconds + time.perf_counter() - begin
            run.seconds, num_samples, signal = processes.agree(seconds, outcome.num_samples, self.request.number)
            run.step += 1
            used_rays = run.num_rays
            run.rays_done, run.num_rays = run.rays_done + used_rays, max(next_rays(num_samples), processes.size)
            ends = limits.is_finished(run.step, run.seconds)
            if ends or signal or limits.is_looked_at(run.step):
                record = self._examined(outcome, used_rays, num_samples)
                if record is None:
                    steps.forget()
                elif processes.is_first:
                    report(record, self.renderer, self.callbacks)
                    show(self.bar, record, limits.progress(run.step, run.seconds, run.begun), run.rays_done)
            if self.checkpoints is not None and (ends or signal or limits.is_saved(run.step)):
                processes.merge_observations(self.renderer)
                if processes.is_first:
                    self.checkpoints.save(run, must_succeed=bool(ends or signal))
            if signal and not ends:
                raise TrainingStopped(signal, f"stopped by {Signals(signal).name} after step {run.step}, all saved")

    def _examined(self, outcome: Outcome, used_rays: int, num_samples: int) -> TrainingRecord | None:
        """The record of a step, or None if the run was broken and has been brought back."""
        run, numbers = self.run, self.processes.mean(outcome.numbers())
        psnr = psnr_of(numbers.pop("mse"))
        shown = {name: numbers.pop(name) for name in SHOWN if name in numbers}
        if self.recovery is not None and self.recovery.check(run.step, self.renderer, run.optimizer, numbers, shown):
            run.rollbacks += 1
            return None
        check_finite(numbers, run.step, self.renderer)
        record = TrainingRecord(
            run.step, run.seconds, numbers, psnr, used_rays, num_samples, outcome.learning_rate_factor
        )
        run.record = vars(record)
        return record
