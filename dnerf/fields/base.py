"""What a radiance field is: density and colour at positions and times."""

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor, nn

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays
from dnerf.core.shortcuts import speaks_for
from dnerf.kernels import FrameTables, GridLevels, MarchGrid

logger = logging.getLogger(__name__)

MOST_AT_ONCE = 1 << 17  # places that `evaluate_along_rays` evaluates in one go: bounds the memory
PAD_TO = 2048  # places: matrix libraries compile code for every new number of rows


class RadianceField(nn.Module, ABC):
    """Density and colour of light at world positions and times."""

    @abstractmethod
    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) >= 0 in 1 / world unit at positions (..., 3) and times (...,) in [0, 1]."""

    @abstractmethod
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions and times as above.

        Directions (..., 3) are unit vectors from the eye into the scene.
        """

    def at_time(self, time: float, extent: Tensor | None = None) -> "RadianceField":
        """A field for one frame, perhaps cheaper to evaluate, at this time alone; itself unless overridden.

        The extent is a box (2, 3) beyond which it will hardly be evaluated, if that is known.
        """
        return self


class TimeDependence(ABC):
    """A field that says whether it changes with time; of other fields that is unknown."""

    @property
    @abstractmethod
    def is_static(self) -> bool:
        """Whether density and colour are the same at all times."""


class IntervalAware(ABC):
    """A field that knows its mean density over an interval better than from one point within it."""

    @abstractmethod
    def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Mean density (...,) over straight intervals between positions (..., 3), and rgb (..., 3) in their middle.

        Mean density times the interval's length is its optical depth. Intervals of length zero have a finite density.
        """


class SignedDistance(ABC):
    """A field with a surface: the zero set of a signed distance, negative inside."""

    @abstractmethod
    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """Signed distance (...,), in world units, at positions (..., 3) and times (...,), with gradients."""


class HasRoughness(ABC):
    """A part that keeps values on lattices, whose differences between neighbours may be given a price."""

    @abstractmethod
    def roughness(self) -> tuple[Tensor, Tensor]:
        """Of neighbours in space, and of second differences in time (zero without time): scalars."""


@dataclass(frozen=True)
class NetworkTables:
    """A canonical field at one time as the fused frame kernel reads it, see `dnerf.kernels.trace_network`."""

    low: Tensor  # (3,) lowest corner of the feature grid's box, in canonical space
    scale: Tensor  # (3,) one by its sides
    table: Tensor  # (T, F) features
    levels: GridLevels  # resolutions and table layout
    weights: list[Tensor]  # of each layer, (out_features, in_features)
    biases: list[Tensor]  # of each layer, (out_features,)
    shifts: Tensor  # (n,) added to the last outputs: the logarithm of density, then harmonics of colours


class NetworkTabled(ABC):
    """A field, of one time, that is a small network on grid features: the fused frame kernel can evaluate it."""

    @abstractmethod
    def network_tables(self) -> NetworkTables | None:
        """Its tables, detached; None, and a warning, where they are not all that it shows."""


class FrameTabled(ABC):
    """A field, of one time, that the fused frame kernel can render, see `dnerf.kernels.trace_network`."""

    @abstractmethod
    def frame_tables(self, grid: MarchGrid, num_rays: int) -> FrameTables | None:
        """What the kernel reads for so many rays; None if it does not serve such a field in the precision and on the
        processor of now. The grid holds the occupied cells of that time."""


def field_at_time(field: RadianceField, time: float, extent: Tensor | None = None) -> RadianceField:
    """`field.at_time`, unless a subclass has another `forward` or `density` than the class that wrote it."""
    return field.at_time(time, extent) if speaks_for(field, "at_time", "forward", "density") else field


@cache
def warn_of_generic_path(part: str) -> None:
    """Say, once, which part of a model keeps its images from the fused frame kernel."""
    logger.warning("images take the generic path, which is slower: the fused frame kernel does not serve %s", part)


def evaluate_along_rays(
    field: RadianceField, rays: Rays, ray_indices: Tensor, distances: Tensor, *, pad_to: int = PAD_TO
) -> FieldOutput:
    """Density (N,) and rgb (N, 3) of a field at distances (N,) along the rays with numbers (N,) int64, without extras.

    At most `MOST_AT_ONCE` places at a time; a multiple of `pad_to` is evaluated.
    """
    count = len(distances)
    padding = -count % pad_to if count else 0
    if padding:
        ray_indices, distances = (torch.cat([x, x[-1:].expand(padding)]) for x in (ray_indices, distances))
    parts = [
        field(*rays.places(*part))
        for part in zip(ray_indices.split(MOST_AT_ONCE), distances.split(MOST_AT_ONCE), strict=True)
    ]
    density, rgb = (torch.cat(x) if len(x) > 1 else x[0] for x in zip(*((p.density, p.rgb) for p in parts)))
    return FieldOutput(density[:count], rgb[:count])
