"""Rays and the samples along them: the data that every sampler, field and compositor exchange."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.core.fixed_size import fit, placed

if TYPE_CHECKING:
    from dnerf.core.compositing import FieldOutput


@dataclass(frozen=True)
class Rays:
    """A batch of R rays, each with its own time; ValueError if a shape does not fit."""

    origins: Tensor  # (R, 3) in world units
    directions: Tensor  # (R, 3), unit norm
    times: Tensor  # (R,) in [0, 1]
    near: Tensor  # (R,) distance along the direction where the ray begins, in world units
    far: Tensor  # (R,) distance where it ends; `far <= near` is an empty ray

    def __post_init__(self) -> None:
        check_shape("origins", self.origins, ("R", 3))
        num_rays = len(self)
        check_shape("directions", self.directions, (num_rays, 3))
        for name in ("times", "near", "far"):
            check_shape(name, getattr(self, name), (num_rays,))

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> "Rays":
        return self._map(lambda x: x[index])

    def places(self, ray_indices: Tensor, distances: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (N, 3), directions (N, 3) and times (N,) at distances (N,) along rays with numbers (N,) int64."""
        # One gather of seven columns is several times quicker than three of one to three.
        columns = torch.cat([self.origins, self.directions, self.times[:, None]], dim=-1)
        return _placed(columns.index_select(0, ray_indices), distances)

    def to(self, *args: Any, **kwargs: Any) -> "Rays":
        """Move or cast every tensor, with the arguments of `Tensor.to`."""
        return self._map(lambda x: x.to(*args, **kwargs))

    def _map(self, function: Callable[[Tensor], Tensor]) -> "Rays":
        return Rays(**{f.name: function(getattr(self, f.name)) for f in fields(self)})


@dataclass(frozen=True)
class Samples:
    """Intervals along R rays, dense (R, S) or packed (N,), and the point of each where the field is evaluated.

    Intervals of a ray are ordered and do not overlap, unless `stretched`; empty ones add nothing. Packed samples of
    ray r are `ray_offsets[r]:ray_offsets[r + 1]`. ValueError if shapes do not fit each other.
    """

    starts: Tensor  # (R, S) or (N,) distance where an interval begins, in world units
    ends: Tensor  # same shape, `ends >= starts`
    num_rays: int  # R
    ray_indices: Tensor | None = None  # None for dense samples; for packed ones (N,) int64, sorted, the ray of each
    points: Tensor | None = None  # where the field is evaluated, same shape as starts; the interval's middle if None
    ray_offsets: Tensor | None = None  # packed only, (R + 1,) int64; derived from `ray_indices` if None
    is_placed: Tensor | None = None  # (R,) bool, the rays that found some of a fixed number of places; None for all
    wanted: Tensor | None = None  # (2,) int64, how many of these places intervals and samples would have filled
    is_opaque: bool = False  # whether what has a length is opaque, whatever its density: surfaces that were found
    proposals: "tuple[tuple[Samples, FieldOutput], ...]" = ()  # earlier passes that placed these; losses read them
    bounds: tuple[Tensor, ...] = ()  # what proposals without colours allow as weights, laid out like starts; see losses

    def __post_init__(self) -> None:
        if self.ray_indices is None:
            check_shape("starts", self.starts, (self.num_rays, "S"))
        else:
            check_shape("starts", self.starts, ("N",))
            check_shape("ray_indices", self.ray_indices, self.starts.shape)
        check_shape("ends", self.ends, self.starts.shape)
        if self.points is not None:
            check_shape("points", self.points, self.starts.shape)
        for bound in self.bounds:
            check_shape("bounds", bound, self.starts.shape)
        if self.ray_offsets is not None:
            check_shape("ray_offsets", self.ray_offsets, (self.num_rays + 1,))
        if self.is_placed is not None:
            check_shape("is_placed", self.is_placed, (self.num_rays,))

    @property
    def is_packed(self) -> bool:
        """Whether samples lie in one row (N,) with `ray_indices`, rather than in a table (R, S)."""
        return self.ray_indices is not None

    @cached_property
    def lengths(self) -> Tensor:
        """Interval lengths, same layout as `starts`, in world units."""
        return self.ends - self.starts

    @cached_property
    def distances(self) -> Tensor:
        """Distances along the rays at which the field is evaluated, same layout as `starts`."""
        return 0.5 * (self.starts + self.ends) if self.points is None else self.points

    @cached_property
    def offsets(self) -> Tensor:
        """(R + 1,) int64, where each ray's packed samples begin and end."""
        if self.ray_offsets is not None:
            return self.ray_offsets
        if self.ray_indices is None:
            raise ValueError("samples must be packed to have offsets, got dense samples")
        rays = torch.arange(self.num_rays + 1, device=self.starts.device)
        return torch.searchsorted(self.ray_indices, rays)

    def per_sample(self, values: Tensor) -> Tensor:
        """Give each sample its ray's value: (R, ...) -> (R, S, ...) or (N, ...)."""
        if self.ray_indices is not None:
            return values.index_select(0, self.ray_indices)
        return values[:, None].expand(-1, self.starts.shape[1], *values.shape[1:])

    def locate(self, rays: Rays) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (..., 3), directions (..., 3) and times (...,) of the samples, (R, S) or (N,)."""
        if self.ray_indices is not None:
            return rays.places(self.ray_indices, self.distances)
        columns = torch.cat([rays.origins, rays.directions, rays.times[:, None]], dim=-1)
        return _placed(self.per_sample(columns), self.distances)

    def padded(self, multiple: int) -> "Samples":
        """Packed samples with intervals of length zero after the last one, up to a multiple of so many.

        They add nothing to an image. Matrix libraries compile code for every new number of rows, so that few
        different numbers are quicker. No samples stay none; proposals are kept.

        Raises:
            ValueError: for dense samples.
        """
        if self.ray_indices is None:
            raise ValueError("samples must be packed to be padded, got dense samples")
        count = len(self.starts)
        padding = -count % multiple if count else 0
        if not padding:
            return self

        def extended(values: Tensor) -> Tensor:
            return torch.cat([values, values[-1:].expand(padding)])

        return replace(
            self, starts=torch.cat([self.starts, self.ends[-1:].expand(padding)]), ends=extended(self.ends),
            ray_indices=extended(self.ray_indices), points=None if self.points is None else extended(self.points),
            ray_offsets=self.offsets + padding * (self.offsets == count), bounds=tuple(map(extended, self.bounds)),
        )  # fmt: skip

    def kept(self, mask: Tensor) -> "Samples":
        """Those packed samples for which `mask` (N,) holds; proposals and bounds are dropped."""
        check_shape("mask", mask, self.starts.shape)
        return self.chosen(mask.nonzero()[:, 0])

    def chosen(self, numbers: Tensor) -> "Samples":
        """Those packed samples whose numbers (n,), in order, are given; proposals and bounds are dropped."""
        if self.ray_indices is None:
            raise ValueError("samples must be packed to be chosen from, got dense samples")
        return Samples(
            self.starts.index_select(0, numbers), self.ends.index_select(0, numbers), self.num_rays,
            ray_indices=self.ray_indices.index_select(0, numbers),
            points=None if self.points is None else self.points.index_select(0, numbers),
            ray_offsets=torch.searchsorted(numbers, self.offsets), is_opaque=self.is_opaque,
        )  # fmt: skip

    def split(self, counts: int | Tensor) -> "Samples":
        """Packed samples, each interval cut into so many equal ones, the field evaluated in the middle of each.

        Args:
            counts: parts of every interval, or (N,) int64, of each.

        Raises:
            ValueError: for dense samples, samples with points of their own, or counts below 1.
        """
        if self.ray_indices is None or self.points is not None:
            raise ValueError("samples must be packed, with their points in the middle, to be split")
        if isinstance(counts, int):
            if counts == 1:
                return self
            counts = torch.full_like(self.ray_indices, counts)
        check_shape("counts", counts, self.starts.shape)
        if not bool((counts >= 1).all()):
            raise ValueError(f"counts must be at least 1, got {int(counts.min())}")
        before = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
        whole, number = parts_of(counts)
        starts, ends, parts = self.starts[whole], self.ends[whole], counts[whole].to(self.starts.dtype)
        return replace(  # exact at both ends
            self, starts=torch.lerp(starts, ends, number / parts), ends=torch.lerp(starts, ends, (number + 1) / parts),
            ray_indices=self.ray_indices[whole], ray_offsets=before[self.offsets],
            bounds=tuple(bound[whole] for bound in self.bounds),
        )  # fmt: skip

    def stretched(self, factors: Tensor) -> "Samples":
        """Intervals so many times as long, (N,) >= 1, around the same middles; they may overlap. For samples that stand
        for others beside them; points must be in the middle."""
        check_shape("factors", factors, self.starts.shape)
        more = 0.5 * (factors - 1) * self.lengths  # nothing at a factor of one, whatever rounding does
        return replace(self, starts=self.starts - more, ends=self.ends + more)

    def fitted(self, counts: Tensor, size: int) -> "tuple[Samples, Tensor]":
        """Packed samples, each interval cut into so many equal ones or (0) left out, in a fixed number of places.

        What `kept` and `split` do, without waiting for a device. Rays that do not fit get none; places that are left
        are intervals of length zero at distance 0, at the ends of all rays.

        Args:
            counts: (N,) int64 parts of every interval, >= 0.
            size: number of samples of the result.

        Returns:
            The samples, and how many there would have been, () int64.

        Raises:
            ValueError: for dense samples, samples with points of their own, or none.
        """
        if self.ray_indices is None or self.points is not None or not len(self.starts):
            raise ValueError("samples must be packed, some, with their points in the middle, to be fitted")
        check_shape("counts", counts, self.starts.shape)
        chosen = fit(self.offsets, counts, size)
        starts, ends, parts = (x[chosen.source] for x in (self.starts, self.ends, counts.to(self.starts.dtype)))
        length = parts.clamp(min=1)
        is_placed = placed(chosen.rays, chosen.is_filled, self.num_rays, chosen.wanted)
        samples = Samples(
            torch.where(chosen.is_filled, torch.lerp(starts, ends, chosen.part / length), 0),
            torch.where(chosen.is_filled, torch.lerp(starts, ends, (chosen.part + 1) / length), 0), self.num_rays,
            ray_indices=chosen.rays, ray_offsets=chosen.offsets, is_opaque=self.is_opaque,
            is_placed=is_placed if self.is_placed is None else is_placed & self.is_placed,
        )  # fmt: skip
        return samples, chosen.wanted

    def packed(self, mask: Tensor | None = None) -> "Samples":
        """Return dense samples as packed ones, only those where `mask` (R, S) holds (all if None)."""
        if self.ray_indices is not None:
            raise ValueError("samples must be dense to be packed, got packed samples")
        if mask is None:
            mask = torch.ones_like(self.starts, dtype=torch.bool)
        check_shape("mask", mask, self.starts.shape)
        return replace(
            self, starts=self.starts[mask], ends=self.ends[mask],
            points=None if self.points is None else self.points[mask], ray_indices=mask.nonzero()[:, 0],
            bounds=tuple(bound[mask] for bound in self.bounds),
        )  # fmt: skip


def parts_of(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Which interval each part is of, and its number there, both (M,), where so many (N,) are made of each in turn."""
    ends = counts.cumsum(0)
    whole = torch.repeat_interleave(counts)
    return whole, torch.arange(len(whole), device=whole.device) - (ends - counts)[whole]


def _placed(rows: Tensor, distances: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, directions and times of rows (..., 7): a ray's origin, direction and time."""
    directions = rows[..., 3:6]
    return torch.addcmul(rows[..., :3], distances[..., None], directions), directions, rows[..., 6]
