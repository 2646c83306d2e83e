"""Where a training run stands, and the callbacks that act on it: small classes that a user can leave out or replace."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from dnerf.data.frames import Frames
from dnerf.data.pixel_samplers import PixelSampler
from dnerf.rendering.renderer import Renderer
from dnerf.training.optimizer import AdamMuon
from dnerf.training.records import TrainingRecord


class Callback:
    """Called by the trainer around its steps; the clock stands still meanwhile.

    A callback may change the model (and then calls `run.renderer.invalidate()`), take back a record
    (`run.take_back()`: later callbacks do not see it) or raise. They are called in the order in which they are given,
    those that are required after all others: what is saved of a step is all that was done in it.

    Attributes:
        handles_failures: whether it looks at records that are not finite; otherwise these end the run.
        is_required: whether a run ends if it cannot write (`OSError`); otherwise that costs its output alone.
        resumes: whether it brings a run's state back; `fit(resume=True)` needs one that does.
    """

    handles_failures = False
    is_required = False
    resumes = False

    def on_train_begin(self, run: "Run") -> None:
        """Before the first step; raises ValueError for what the run lacks."""

    def on_step_begin(self, run: "Run") -> None:
        """Before a step."""

    def on_step_end(self, run: "Run") -> None:
        """After a step; `run.record` is its record, if it has one."""

    def on_train_end(self, run: "Run") -> None:
        """After the last step, the model in evaluation mode."""

    def state_dict(self) -> dict[str, Tensor]:
        """What a continued run has to know, as tensors of fixed shapes."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over a state that `state_dict` gave."""


@dataclass
class Run:
    """One training run; one that is continued from its state cannot be told from one that never stopped."""

    renderer: Renderer  # the model that is trained
    frames: Frames  # which are learnt, on the renderer's device
    optimizer: AdamMuon  # of the renderer's parameters
    generator: torch.Generator  # of the random rays, points and backgrounds
    losses: nn.ModuleDict  # terms by name
    pixels: PixelSampler  # draws the pixels of a step
    callbacks: Mapping[str, Callback] = field(default_factory=dict)  # by name, in the order of their calls
    folder: Path | None = None  # of the run's files
    resume: bool = False  # whether to continue what lies in the folder
    num_rays: int = 1  # of the next step
    most_rays: int = 1  # of any step
    step: int = 0  # steps done
    seconds: float = 0.0  # training time spent
    progress: float = 0.0  # in [0, 1]; it never falls, not even if a run is continued for longer
    rays_done: int = 0  # rays of all steps done
    rate_factor: float = 1.0  # on all learning rates, beside their schedule's
    record: TrainingRecord | None = None  # of the latest step, if it has one; callbacks may take it back
    last_record: TrainingRecord | None = None  # the latest one that stands
    ends: bool = False  # whether the latest step was the last one
    signal: int = 0  # that has asked to stop, 0 for none
    _earlier_record: TrainingRecord | None = None

    def set_record(self, record: TrainingRecord | None) -> None:
        """Give the latest step its record, or none."""
        self.record, self._earlier_record = record, self.last_record
        self.last_record = record or self.last_record

    def take_back(self) -> None:
        """Let the latest step have no record: what it says does not hold any more."""
        self.record, self.last_record = None, self._earlier_record

    @property
    def parts(self) -> dict[str, nn.Module | Callback]:
        """By name, those that keep what steps change; "renderer" is the one that is optimised."""
        modules = {"renderer": self.renderer, "losses": self.losses, "pixels": self.pixels}
        return {**modules, **{f"callbacks.{name}": callback for name, callback in self.callbacks.items()}}

    def folder_for(self, callback: Callback) -> Path:
        """The run's folder; ValueError, naming the callback, if it has none."""
        if self.folder is None:
            raise ValueError(f"{type(callback).__name__} needs a folder, give fit(folder=...)")
        return self.folder
