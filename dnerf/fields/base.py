"""What a radiance field is: density and colour at positions and times."""

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays, Samples
from dnerf.core.shortcuts import speaks_for
from dnerf.kernels import FrameTables, GridLevels, MarchGrid

logger = logging.getLogger(__name__)

MOST_AT_ONCE = 1 << 17  # places that `evaluate_along_rays` evaluates in one go: bounds the memory
COPIES = 8  # of each number in training: weight, gradient, Adam's moments, what recovery keeps of them, the average
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

    @property
    def knows_intervals(self) -> bool:
        """Whether it does: a field around another one does if that one does."""
        return True

    @abstractmethod
    def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Mean density (...,) over straight intervals between positions (..., 3), and rgb (..., 3) in their middle.

        Mean density times the interval's length is its optical depth. Intervals of length zero have a finite density.
        """


class SignedDistance(ABC):
    """A field with a surface: the zero set of a signed distance, negative inside."""

    @property
    def has_surface(self) -> bool:
        """Whether it has one: a field around another one does if that one does."""
        return True

    @property
    def detail(self) -> float | Tensor:
        """Size of its finest details, in world units: a good step for differences of the distance."""
        return 1e-3

    @abstractmethod
    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        """Signed distance (...,), in world units, at positions (..., 3) and times (...,), with gradients."""


class HasRoughness(ABC):
    """A part that keeps values on lattices, whose differences between neighbours may be given a price."""

    @abstractmethod
    def roughness(self, turn: Tensor | int = 0) -> tuple[Tensor, Tensor]:
        """Of neighbours in space, and of second differences in time (zero without time): scalars.

        Of large lattices only at some places, others at every turn, a number ().
        """


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


def training_gib(count: int) -> float:
    """Memory that so many learnt numbers of four bytes take in training, in GiB."""
    return COPIES * 4 * count / 2**30


def interval_aware(field: RadianceField) -> IntervalAware | None:
    """The field as one that knows intervals, if it does; not if a subclass has another `forward` or `density`."""
    if not isinstance(field, IntervalAware) or not speaks_for(field, "between", "forward", "density"):
        return None
    return field if field.knows_intervals else None


def surface_of(field: nn.Module) -> SignedDistance | None:
    """The field, or part of one, as what has a surface, if it has one."""
    return field if isinstance(field, SignedDistance) and field.has_surface else None


class Ends(NamedTuple):
    """Ends of intervals one after the other; what one interval's end and the next one's start share is there once."""

    positions: Tensor  # (M, 3)
    directions: Tensor  # (M, 3)
    times: Tensor  # (M,)
    last: Tensor  # (...,) int64, where the end of each interval is; its start is the one before

    def pairs(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Values (..., n) at the start and the end of each interval, of values (M, n) at all ends."""
        number = self.last.reshape(-1)
        first, last = (values.index_select(0, i).unflatten(0, self.last.shape) for i in (number - 1, number))
        return first, last


def ends_of(starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> Ends:
    """Ends of intervals between positions (..., 3), for fields that are evaluated at both, see `IntervalAware`.

    Intervals that touch share an end, bit by bit; a GPU would have to wait for their number, and evaluates all. Copies
    of the last end make their number a multiple of `PAD_TO`.
    """
    rows = [torch.cat([x, directions, times[..., None].to(x.dtype)], dim=-1).reshape(-1, 7) for x in (starts, ends)]
    number = torch.arange(times.numel(), device=times.device)
    is_new = torch.ones_like(number, dtype=torch.bool)
    if times.is_cpu:
        is_new[1:] = (rows[0][1:] != rows[1][:-1]).any(-1)
    place = number + is_new.cumsum(0)
    count = len(number) + (int(is_new.sum()) if times.is_cpu else len(number))
    source = number.new_full((count + -count % PAD_TO,), 2 * len(number) - 1)
    source[place - 1] = number
    source[place] = number + len(number)
    joined = torch.cat(rows).index_select(0, source)
    return Ends(joined[:, :3], joined[:, 3:6], joined[:, 6].to(times.dtype), place.reshape(times.shape))


def evaluate_samples(field: RadianceField, samples: Samples, rays: Rays) -> tuple[FieldOutput, Tensor, Tensor]:
    """What a field says of samples of R rays, between their ends if it knows intervals, their positions, and times."""
    positions, directions, times = samples.locate(rays)
    aware = None if samples.is_opaque else interval_aware(field)
    if aware is None:
        return field(positions, directions, times), positions, times
    starts, ends = (replace(samples, points=x).locate(rays)[0] for x in (samples.starts, samples.ends))
    return aware.between(starts, ends, directions, times), positions, times


def density_of_samples(field: RadianceField, samples: Samples, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
    """The density (...,) of samples of R rays alone, and their positions and times, see `evaluate_samples`."""
    if interval_aware(field) is not None:  # density at points is too high at an angle, and would hide what is behind
        output, positions, times = evaluate_samples(field, samples, rays)
        return output.density, positions, times
    positions, _, times = samples.locate(rays)
    return field.density(positions, times), positions, times


def evaluate_along_rays(field: RadianceField, rays: Rays, samples: Samples, *, pad_to: int = PAD_TO) -> FieldOutput:
    """Density (N,) and rgb (N, 3) of a field at packed samples (N,) of rays, without extras.

    At most `MOST_AT_ONCE` places at a time; a multiple of `pad_to` is evaluated.
    """
    aware = interval_aware(field)
    columns = [samples.ray_indices, *((samples.distances,) if aware is None else (samples.starts, samples.ends))]
    count = len(samples.starts)
    padding = -count % pad_to if count else 0
    if padding:
        columns = [torch.cat([x, x[-1:].expand(padding)]) for x in columns]

    def evaluated(ray_indices: Tensor, first: Tensor, *last: Tensor) -> FieldOutput:
        positions, directions, times = rays.places(ray_indices, first)
        if aware is None:
            return field(positions, directions, times)
        return aware.between(positions, rays.places(ray_indices, *last)[0], directions, times)

    parts = [evaluated(*part) for part in zip(*(x.split(MOST_AT_ONCE) for x in columns), strict=True)]
    density, rgb = (torch.cat(x) if len(x) > 1 else x[0] for x in zip(*((p.density, p.rgb) for p in parts)))
    return FieldOutput(density[:count], rgb[:count])
