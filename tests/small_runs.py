"""A small model with every kind of state that a training run has, its trainer, and a run in the middle."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn

from dnerf.core.backgrounds import RandomBackground
from dnerf.data import Frames, SyntheticData
from dnerf.data.pixel_samplers import ErrorGuidedPixels, UniformPixels
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField
from dnerf.losses import PhotometricLoss
from dnerf.rendering import Renderer
from dnerf.samplers import OccupancyGrid, OccupancySampler
from dnerf.scenes import make_scene
from dnerf.training import AdamSettings, Callback, Recovery, Run, Trainer, TrainingRecord

BOX = ((-1.5, -1.5, -1.5), (1.5, 1.5, 1.5))


class Watch(Callback):
    """Keeps all records that stand, and does something after each step."""

    def __init__(self, work: Callable[[Run], Any] = lambda run: None) -> None:
        self.work, self.records = work, []

    def on_step_end(self, run: Run) -> None:
        self.records += [] if run.record is None else [run.record]
        self.work(run)


def weights(renderer: Renderer) -> torch.Tensor:
    return torch.cat([p.detach().flatten().cpu() for p in renderer.parameters()])


def small_frames(num_frames: int = 4) -> Frames:
    return SyntheticData(make_scene("walker"), 12, num_train=num_frames).frames("train")


def small_renderer(seed: int = 0, features: int = 4) -> Renderer:
    torch.manual_seed(seed)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=3, time_frequencies=2)
    canonical = GridField(BOX, (4, 8), features, hidden_features=8)
    grid = OccupancyGrid(BOX, 8, num_slabs=2, update_every=3, num_probes=64)
    return Renderer(DeformedField(deformation, canonical), OccupancySampler(grid, 0.1, pad_to=64), RandomBackground())


def small_trainer(**changes: Any) -> Trainer:
    settings = {"num_steps": 10, "num_rays": 16, "target_samples": 400, "optimizer": AdamSettings(orthogonal=True)}
    return Trainer(**(settings | changes))


def run_of(renderer: Renderer, step: int = 5, callbacks: Mapping[str, Callback] | None = None) -> Run:
    """A run after some steps, the last of which had a record."""
    frames = small_frames()
    pixels = ErrorGuidedPixels(UniformPixels(), resolution=4)
    pixels.begin(frames)
    optimizer = AdamSettings(orthogonal=True).build(renderer)
    generator = torch.Generator().manual_seed(4)
    for parameter in renderer.parameters():
        parameter.grad = torch.rand(parameter.shape, generator=generator)
    optimizer.step()
    record = TrainingRecord(step, 1.25, {"loss": 0.1}, 10.0, 37, 300, 0.5, 0.25, 0.75)
    return Run(
        renderer, frames, optimizer, generator, nn.ModuleDict({"rgb": PhotometricLoss()}), pixels,
        {"recovery": Recovery()} if callbacks is None else callbacks, num_rays=37, most_rays=64, step=step,
        seconds=1.25, progress=0.5, rays_done=99, last_record=record,
    )  # fmt: skip
