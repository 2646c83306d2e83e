"""What a sampler is, and what some of them can do beside: each ability is a small class of its own."""

from abc import ABC, abstractmethod
from collections.abc import Hashable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dnerf.core.cameras import Camera
from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField
from dnerf.kernels import MarchGrid


class Sampler(nn.Module, ABC):
    """Places samples along rays. Training mode may place them at random, evaluation mode never does."""

    sets_bounds: bool = False  # whether the samples of training carry `Samples.bounds`, by which proposals learn

    @abstractmethod
    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Samples along R rays, dense or packed; samplers that look where something is evaluate the field.

        Gradients reach rays through the positions of samples, and through where samples lie on them as far as the
        sampler says. `StratifiedSampler`: all of it, a box's faces included: camera poses may be fitted by them.
        `ImportanceSampler` and `OccupancySampler`: distances that follow density count as constants. Gradients are then
        those of the light up to the quadrature's error, not those of the number that was computed.
        """

    def update(self, field: RadianceField, step: int) -> None:
        """Learn from the field after so many training steps; does nothing unless overridden."""

    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Learn from the density (...,) at the samples of a training step, at positions (..., 3) and times (...,)."""


@dataclass(frozen=True)
class OccupiedCells:
    """Which cells of a box are occupied."""

    box: Tensor  # (2, 3) corners, in world units
    mask: Tensor  # (Gx, Gy, Gz) bool


class OccupancyAware(ABC):
    """A sampler that knows where something is, and so which pixels can show it."""

    @abstractmethod
    def occupied_cells(self, time: float | None) -> OccupiedCells:
        """The cells that images look into at a time in [0, 1]; None for those of any time."""

    @abstractmethod
    def occupied_positions(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) and times (N,) in occupied cells, evenly spread over all of them as the given numbers are:
        (N, 5) in [0, 1), which cell, and the time and the position within it."""

    @abstractmethod
    def march_grid(self, time: float, dtype: torch.dtype) -> MarchGrid:
        """The cells of which images of a time keep the intervals; in the rays' dtype it may round to another slab."""

    @abstractmethod
    def visible_rays(self, camera: Camera, time: float) -> tuple[Tensor, Rays] | None:
        """Pixels of a view, on the sampler's device, in whose rays there may be samples in evaluation mode.

        Returns:
            Their numbers (P,) int64, `row * width + column`, in order, and their rays, which may be cut short where
            they meet nothing, by whole intervals; None for all of them.
        """


class FrontToBack(ABC):
    """A sampler that places the first samples of rays without the others, so that rays can end where light does."""

    @abstractmethod
    def first(self, rays: Rays, most: int) -> Samples:
        """In evaluation mode, the first samples, packed, at most `most` of each of R rays.

        What `forward` places from the end of a ray's last one on is what would have followed.
        """

    @abstractmethod
    def refined(
        self, samples: Samples, rays: Rays, field: RadianceField, transmittance: Tensor, min_weight: float
    ) -> tuple[Samples, FieldOutput]:
        """In evaluation mode, subdivide those of the samples that `first` placed that are visible.

        The transmittance (R,) is that before each ray's first sample; what has less than `min_weight` of a share in the
        image may be left out.

        Returns:
            Packed samples of the same rays, in the same intervals, and the field's output there, without extras.
        """


@dataclass(frozen=True)
class Capacity:
    """How many places there are for samples."""

    marched: int  # for intervals that may hold something
    kept: int  # for samples
    min_weight: float | None = None  # in the image, up to which intervals are left out; None as in training


class FixedCapacity(ABC):
    """A sampler that fills a fixed number of places without waiting for a device, so that CUDA graphs can replay it."""

    @abstractmethod
    def sample_fixed(
        self, rays: Rays, field: RadianceField, capacity: Capacity, *, generator: torch.Generator | None = None
    ) -> Samples:
        """Packed samples in `capacity.kept` places, some of length zero; `Samples.wanted` says how many were wanted.

        Rays that do not fit get none: they show the background, and train nothing.
        """

    @abstractmethod
    def path_key(self) -> Hashable:
        """What decides, beside tensors, how samples are placed now: when it changes, graphs are recorded anew."""

    @abstractmethod
    def probes(self, step: int) -> Tensor | None:
        """Random numbers for `learn`, or None if `update` would do nothing after so many steps."""

    @abstractmethod
    def learn(self, field: RadianceField, probes: Tensor) -> None:
        """What `update` does, with `probes`, without waiting for a device."""
