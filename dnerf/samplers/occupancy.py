"""Occupancy-guided packed sampling: empty space, at the time of the ray, costs nothing."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dnerf.cameras import Camera
from dnerf.checks import check_positive, check_whole
from dnerf.compositing import FieldOutput, render_weights
from dnerf.fields.base import RadianceField, ask_along
from dnerf.fixed_size import placed
from dnerf.kernels import MarchGrid, footprints, march, march_to_size, seen_parts
from dnerf.rays import Rays, Samples
from dnerf.samplers.occupancy_grid import OccupancyGrid
from dnerf.samplers.visibility import joined, visible_weights

# Few rays of a training batch have more samples in occupied cells: a second round costs more than it saves.
FIRST_ROUND = 64
MOST_AT_ONCE = 1 << 16  # samples that the filter asks, where many rays meet haze: about 50 MiB in the networks' layers
ROOM = 2  # intervals left before and behind covering cells: those kept are whole, whatever rounding does


class OccupancySampler(OccupancyGrid):
    """Equal steps through the occupied cells of a grid over space and time slabs.

    Every cell of every slab keeps a decaying maximum of the densities seen in it: those of the training samples
    themselves (free) and of random probes of the field. A cell is occupied while it, or a neighbour in space or
    time, is above the smaller of `threshold` and half the mean of all cells. So a thin start empties nothing that
    was looked at (uniform density is above half its mean), empty space is dropped as soon as matter stands out, and
    neighbours and probes bring back matter that was lost or lies where nobody has looked yet.

    Sources: instant-ngp (Mueller et al. 2022, appendix C) for the decaying maximum, nerfacc for a threshold that
    follows the mean; slabs in time and the use of training samples are this project's.

    Args:
        box: (2, 3) corners of the space that is sampled, in world units.
        step_size: length of an interval, in world units.
        splits: in training, from `coarse_until` on, intervals in which something is seen (see `min_weight`)
            are cut into so many, at which the field is asked: empty and hidden ones are passed in long steps.
        render_splits: the same in evaluation mode; None for `splits`. A field that was learnt at intervals which begin
            anywhere is known between their middles too, and pictures gain from shorter ones.
        split_weight: weight in the picture up to which an interval is not split, in [0, 1): what a surface's neighbours
            and haze hold would cost as many samples as the surface itself.
        coarse_step: length of an interval when training begins; it shrinks evenly (by equal factors in equal progress)
            to `step_size`. Long intervals clear haze early and see more rays for the same samples, short ones
            sharpen surfaces later. None for `step_size` from the start; evaluation always takes `step_size`.
        coarse_until: fraction of training, in (0, 1], at which `step_size` is reached.
        resolution: cells along the box's longest side; cells are nearly cubes.
        num_slabs: slabs that time is cut into, K.
        threshold: density, in 1 / world unit, above which a cell is occupied.
        decay: factor on all maxima at each update.
        update_every: training steps between updates.
        num_probes: random cells asked at each update.
        margin: cells by which occupied regions are widened in space (0 or 1); time is widened by one slab, and in
            evaluation, if `render_margin` differs, by the nearer half of one.
        render_margin: the same in evaluation mode. Training needs the margin, for matter to move into; pictures of a
            trained field hardly do, and it is half of their samples. `fill` always takes `margin`.
        narrow_from: fraction of training, in [0, 1], from which on training marches through what pictures do: once
            shapes stand, most samples in the margin are asked for nothing. Probes still find what comes into being.
        min_weight: in training, the field is first asked for densities without gradients, front to back, and only
            samples whose weight in the picture exceeds this get the pass with gradients; 0 for all. (Pictures leave out
            less than `Renderer.stop_transmittance` instead, and ask twice only to find what is to be split.)
        filter_joins: until intervals are split, the filter of `min_weight` asks once for so many neighbouring ones, and
            keeps all or none.
        pad_to: in training, and where intervals are split, the number of samples is rounded up to a multiple of this,
            see `Samples.padded` (1 for no padding).

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        step_size: float = 0.02,
        resolution: int = 64,
        *,
        coarse_step: float | None = None,
        coarse_until: float = 0.5,
        num_slabs: int = 16,
        threshold: float = 1.0,
        decay: float = 0.8,
        update_every: int = 16,
        num_probes: int = 1 << 16,
        margin: int = 1,
        render_margin: int = 1,
        narrow_from: float = 1.0,
        splits: int = 1,
        render_splits: int | None = None,
        split_weight: float = 0.0,
        min_weight: float = 0.0,
        filter_joins: int = 1,
        pad_to: int = 2048,
    ) -> None:
        super().__init__(
            box, resolution, num_slabs=num_slabs, threshold=threshold, decay=decay, update_every=update_every,
            num_probes=num_probes, margin=margin, render_margin=render_margin,
        )  # fmt: skip
        for name, value in (
            ("step_size", step_size),
            ("coarse_step", step_size if coarse_step is None else coarse_step),
            ("coarse_until", coarse_until),
        ):
            check_positive(name, value)
        for name, count in (
            ("splits", splits),
            ("render_splits", splits if render_splits is None else render_splits),
            ("filter_joins", filter_joins),
            ("pad_to", pad_to),
        ):
            check_whole(name, count)
        if coarse_until > 1:
            raise ValueError(f"coarse_until must be in (0, 1], got {coarse_until}")
        for name, value in (("split_weight", split_weight), ("min_weight", min_weight)):
            if not 0 <= value < 1:
                raise ValueError(f"{name} must be in [0, 1), got {value}")
        if not 0 <= narrow_from <= 1:
            raise ValueError(f"narrow_from must be in [0, 1], got {narrow_from}")
        self.step_size = step_size
        self.coarse_step = step_size if coarse_step is None else coarse_step
        self.coarse_until = coarse_until
        self.training_step = self.coarse_step
        self.splits = splits
        self.render_splits = splits if render_splits is None else render_splits
        self.split_weight = split_weight
        self.training_splits = 1
        self.narrow_from = narrow_from
        self.is_narrow = False
        self.min_weight = min_weight
        self.filter_joins = filter_joins
        self.pad_to = pad_to
        self.sizes: tuple[int, int] | None = None
        self.register_buffer("length", torch.tensor(float(step_size)), persistent=False)
        self.register_buffer("wanted", torch.zeros(2, dtype=torch.int64), persistent=False)
        self.length: Tensor
        self.wanted: Tensor

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Packed samples; intervals begin at random offsets in training, at multiples of the step in evaluation."""
        if self.training and self.sizes is not None:
            samples, wanted = self.to_size(rays, field, *self.sizes, min_weight=self.min_weight, generator=generator)
            self.wanted.copy_(wanted)
            return samples
        samples = self._march(rays, self._jitter(rays, generator))
        if not self.training:
            return samples.split(self.render_splits)
        if self.min_weight > 0:
            samples = self._visible(samples, rays, field)
        else:
            samples = samples.split(self.training_splits)
        return samples.padded(self.pad_to)

    def _jitter(self, rays: Rays, generator: torch.Generator | None) -> Tensor:
        jitter = torch.zeros_like(rays.near)
        return jitter.uniform_(generator=generator) if self.training else jitter

    def first(self, rays: Rays, most: int) -> Samples | None:
        """In evaluation mode, the first samples of each ray; what lies behind is not marched through."""
        return None if self.training else self._march(rays, torch.zeros_like(rays.near), most)

    @torch.no_grad()
    def refined(
        self, samples: Samples, rays: Rays, field: RadianceField, transmittance: Tensor, min_weight: float
    ) -> tuple[Samples, FieldOutput]:
        """The intervals above `min_weight`, those above `split_weight` split; as they are, if pictures split none.

        What is known is not asked again: whole intervals, and parts in whose middle their interval's is.
        """
        assert samples.ray_indices is not None
        known = ask_along(field, rays, samples.ray_indices, samples.distances, pad_to=self.pad_to)
        if self.render_splits == 1:
            return samples, known
        parts = seen_parts(
            samples.starts, samples.ends, samples.offsets, known.density, transmittance,
            splits=self.render_splits, split_weight=self.split_weight, min_weight=min_weight,
        )  # fmt: skip
        placed_parts = Samples(
            parts.starts, parts.ends, len(rays), ray_indices=parts.ray_indices, ray_offsets=parts.offsets
        )
        density, rgb = (x.index_select(0, parts.whole) for x in (known.density, known.rgb))
        if len(parts.new):
            numbers, distances = (x.index_select(0, parts.new) for x in (parts.ray_indices, placed_parts.distances))
            asked = ask_along(field, rays, numbers, distances, pad_to=self.pad_to)
            density[parts.new], rgb[parts.new] = asked.density, asked.rgb
        return placed_parts, FieldOutput(density, rgb)

    def fix_sizes(self, marched: int | None, kept: int | None = None) -> None:
        """In training, place samples by `to_size` from now on, in so many places; None for no more."""
        self.sizes = None if marched is None or kept is None else (marched, kept)

    def fullness(self) -> float:
        """The larger share of its fixed places that the last batch wanted; above 1, some rays went without."""
        if self.sizes is None:
            return super().fullness()
        return max(wanted / size for wanted, size in zip(self.wanted.tolist(), self.sizes, strict=True))

    @property
    def settings(self) -> tuple[object, ...]:
        """See `Sampler.settings`."""
        return self.sizes, self.training, self.training_splits, self.render_splits, self.is_narrow

    @torch.no_grad()
    def to_size(
        self,
        rays: Rays,
        field: RadianceField,
        marched: int,
        kept: int,
        *,
        min_weight: float,
        generator: torch.Generator | None = None,
    ) -> tuple[Samples, Tensor]:
        """Samples in a fixed number of places, see `Sampler.to_size`; all intervals are asked for densities at once."""
        intervals, num_marched = march_to_size(
            rays.origins,
            rays.directions,
            rays.near,
            rays.far,
            times=rays.times,
            jitter=self._jitter(rays, generator),
            occupancy=self.looked_into(self.is_narrow or not self.training)[0],
            aabb=self.box,
            step=self.length if self.training else self.length.new_full((), self.step_size),
            size=marched,
        )
        is_filled = intervals.ends > intervals.starts
        samples = Samples(
            intervals.starts, intervals.ends, len(rays), ray_indices=intervals.ray_indices,
            ray_offsets=intervals.offsets, is_placed=placed(intervals.ray_indices, is_filled, len(rays), num_marched),
        )  # fmt: skip
        positions, _, times = samples.locate(rays)
        density = field.density(positions, times)
        if self.training:
            self.observe(positions, times, torch.where(is_filled, density, 0))
        weights = render_weights(density * samples.lengths, samples)
        splits = self.training_splits if self.training else self.render_splits
        is_seen = ~(weights <= min_weight) if min_weight else torch.ones_like(weights, dtype=torch.bool)
        counts = self._counts(weights, splits) * (is_seen & is_filled)  # NaN is
        samples, num_wanted = samples.fitted(counts, kept)
        return samples, torch.stack([num_marched, num_wanted])

    def _split(self, samples: Samples, weights: Tensor, count: int) -> Samples:
        """Samples of which those whose weight exceeds `split_weight` are cut into so many parts."""
        return samples if count == 1 else samples.split(self._counts(weights, count))

    def _counts(self, weights: Tensor, most: int) -> Tensor:
        """Into how many parts intervals of such weights are cut, int64."""
        return torch.where(weights <= self.split_weight, 1, most)

    def _march(self, rays: Rays, jitter: Tensor, most: int | None = None) -> Samples:
        occupied, skips = self.looked_into(self.is_narrow or not self.training)
        marched = march(
            rays.origins,
            rays.directions,
            rays.near,
            rays.far,
            times=rays.times,
            jitter=jitter,
            occupancy=occupied,
            aabb=self.box,
            step=self.training_step if self.training else self.step_size,
            max_samples_per_ray=most,
            skips=skips,
        )
        return Samples(
            marched.starts, marched.ends, len(rays), ray_indices=marched.ray_indices, ray_offsets=marched.offsets
        )

    def set_progress(self, progress: float) -> None:
        """Shorten and split the intervals of training and drop its margin as it goes on, `progress` in [0, 1]."""
        part = min(progress / self.coarse_until, 1.0)
        self.training_splits = self.splits if part == 1 else 1
        self.training_step = self.coarse_step * (self.step_size / self.coarse_step) ** part
        self.length.fill_(self.training_step)
        self.is_narrow = progress >= self.narrow_from

    def grid_at(self, time: float, dtype: torch.dtype) -> MarchGrid:
        """The slab that pictures of a time look into."""
        occupied, skips = self.looked_into(is_narrow=True)
        slab = int(torch.tensor(time, dtype=dtype) * len(occupied))  # rounds as times of rays do
        slab = min(slab, len(occupied) - 1)
        return MarchGrid(occupied[slab], skips[slab], self.box, self.step_size, self.render_splits, self.split_weight)

    @torch.no_grad()
    def seen_rays(self, camera: Camera, time: float) -> tuple[Tensor, Rays] | None:
        """Pixels that occupied cells cover, see `footprints`, and their rays; all if a cell lies beside the camera.

        So a frame costs what the body covers, not what the picture holds. Rays begin and end, a whole number of
        intervals away from where they did, before and behind the cells that cover them: their intervals stay, up to
        rounding.
        """
        grid, lens, view = self.grid_at(time, camera.pose.dtype), camera.intrinsics.lens, camera.intrinsics
        covered = footprints(grid.occupancy, grid.aabb, camera.pose, lens, (view.height, view.width))
        if covered is None:
            return None
        rays = camera.rays(time, covered.pixels)
        lengths = rays.far / camera.far  # of a ray, for each unit of z-depth
        before, behind = covered.depths.mul_(lengths).sub_(rays.near).div_(grid.step)
        return covered.pixels, replace(
            rays,
            near=before.sub_(ROOM).floor_().clamp_(min=0).mul_(grid.step).add_(rays.near),
            far=torch.minimum(rays.far, behind.add_(ROOM).ceil_().mul_(grid.step).add_(rays.near)),
        )

    def _visible(self, samples: Samples, rays: Rays, field: RadianceField) -> Samples:
        asked, number = joined(samples, self.filter_joins if self.training_splits == 1 else 1)
        weights = visible_weights(
            asked, rays, field, self.min_weight,
            first_round=FIRST_ROUND, most_at_once=MOST_AT_ONCE, pad_to=self.pad_to, observe=self.observe,
        )  # fmt: skip
        weights = weights[number]
        is_visible = ~(weights <= self.min_weight)  # NaN is
        kept = samples.kept(is_visible)
        return self._split(kept, weights[is_visible], self.training_splits)
