"""Where a training run stands: everything that a step changes, and what callbacks may look at."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from dnerf.data.frames import Frames
from dnerf.data.pixel_samplers import PixelSampler
from dnerf.rendering.renderer import Renderer
from dnerf.training.callbacks import Callback
from dnerf.training.optimizer import AdamMuon
from dnerf.training.records import TrainingRecord


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
