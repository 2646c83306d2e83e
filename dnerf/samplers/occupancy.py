"""Occupancy-guided packed sampling: empty space, at the time of the ray, costs nothing."""

from collections.abc import Hashable
from dataclasses import replace

import torch
from torch import Tensor, nn

from dnerf.core.cameras import Camera
from dnerf.core.checks import check_positive, check_whole, check_within
from dnerf.core.compositing import FieldOutput, render_weights
from dnerf.core.fixed_size import placed
from dnerf.core.quadrature import interval_depths
from dnerf.core.rays import Rays, Samples
from dnerf.core.schedules import Schedule, Scheduled, at
from dnerf.fields.base import RadianceField, density_of_samples, evaluate_along_rays, interval_aware
from dnerf.kernels import MarchGrid, footprints, march, march_to_size, seen_parts
from dnerf.samplers.base import Capacity, FixedCapacity, FrontToBack, OccupancyAware, OccupiedCells, Sampler
from dnerf.samplers.occupancy_grid import OccupancyGrid
from dnerf.samplers.visibility import by_chance, visible_weights

# Few rays of a training batch have more samples in occupied cells: a second round costs more than it saves.
FIRST_ROUND = 64
MOST_AT_ONCE = 1 << 16  # samples that the filter evaluates at once: about 50 MiB in the networks' layers
ROOM = 2  # intervals left before and behind covering cells: those kept are whole, whatever rounding does


class OccupancySampler(Sampler, OccupancyAware, FrontToBack, FixedCapacity, Scheduled):
    """Equal steps through the occupied cells of a grid over space and time slabs.

    Args:
        grid: knows which cells are occupied, and learns it.
        step_size: length of an interval, in world units; a schedule for one that follows training, whose value at its
            end is that of evaluation. Long intervals clear floaters early and see more rays for the same samples, short
            ones sharpen surfaces later.
        subdivision: in training, from `subdivide_from` on, intervals in which something is visible (see `min_weight`)
            are cut into so many, at which the field is evaluated: empty and hidden ones are passed in long steps.
        render_subdivision: the same in evaluation mode; None for `subdivision`. A field that was learnt at intervals
            which begin anywhere is known between their middles too, and images gain from shorter ones.
        subdivision_weight: weight in the image up to which an interval is not cut, in [0, 1): what a surface's
            neighbours hold would cost as many samples as the surface itself.
        subdivide_from: fraction of training, in [0, 1], from which on intervals are cut.
        narrow_from: fraction of training, in [0, 1], from which on training marches through what images do: once
            shapes stand, most samples in the dilation are evaluated for nothing. Probes still find what comes into
            being.
        min_weight: in training, the field is first evaluated for densities without gradients, front to back, and only
            samples whose weight in the image exceeds this get the pass with gradients; 0 for all. (Images leave out
            less than `Renderer.stop_transmittance` instead, and evaluate twice only to find what is to be cut.)
        chance_weight: weight in the image, in [0, 1), below which that filter takes samples by chance, in proportion to
            it, and makes them count for as much more: of much that is thin a few samples learn, and more rays are seen
            for the same number. 0 takes all; so do fields whose density needs an interval's ends (`IntervalAware`).
        pad_to: in training, and where intervals are cut, the number of samples is rounded up to a multiple of this,
            see `Samples.padded` (1 for no padding).

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, grid: OccupancyGrid, step_size: float | Schedule = 0.02, *, subdivision: int = 1,
        render_subdivision: int | None = None, subdivision_weight: float = 0.0, subdivide_from: float = 0.5,
        narrow_from: float = 1.0, min_weight: float = 0.0, chance_weight: float = 0.0, pad_to: int = 2048,
    ) -> None:  # fmt: skip
        super().__init__()
        self.grid = grid
        self.step_schedule = step_size
        self.step_size = at(step_size, 1.0)
        self.subdivision, self.pad_to = subdivision, pad_to
        self.render_subdivision = subdivision if render_subdivision is None else render_subdivision
        self.subdivision_weight, self.min_weight, self.chance_weight = subdivision_weight, min_weight, chance_weight
        self.subdivide_from, self.narrow_from = subdivide_from, narrow_from
        for name in ("subdivision", "render_subdivision", "pad_to"):
            check_whole(name, getattr(self, name))
        for name in ("subdivision_weight", "min_weight", "chance_weight"):
            check_within(name, getattr(self, name), "[0, 1)")
        for name in ("subdivide_from", "narrow_from"):
            check_within(name, getattr(self, name), "[0, 1]")
        for progress in (0.0, 1.0):
            check_positive("step_size", at(step_size, progress))
        # Of a step in training: a tensor, since graphs that replay steps read it.
        self.length = nn.Buffer(torch.tensor(self.step_size), persistent=False)
        self.set_progress(0.0)

    def set_progress(self, progress: float) -> None:
        """Shorten and cut the intervals of training and drop its dilation as it goes on, `progress` in [0, 1]."""
        self.training_subdivision = self.subdivision if progress >= self.subdivide_from else 1
        self.training_step = at(self.step_schedule, progress)
        self.length.fill_(self.training_step)
        self.is_narrow = progress >= self.narrow_from

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Packed samples; intervals begin at random offsets in training, at multiples of the step in evaluation."""
        samples = self._march(rays, self._jitter(rays, generator))
        if not self.training:
            return samples.split(self.render_subdivision)
        if self.min_weight > 0:
            samples = self._visible(samples, rays, field, generator)
        else:
            samples = samples.split(self.training_subdivision)
        return samples.padded(self.pad_to)

    def update(self, field: RadianceField, step: int) -> None:
        """Every `grid.update_every` steps, probe cells of the field and decide anew which are occupied."""
        probes = self.probes(step)
        if probes is not None:
            self.learn(field, probes)

    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Enter the densities of training samples, all (N, ...), into the grid."""
        self.grid.observe(positions, times, density)

    def probes(self, step: int) -> Tensor | None:
        """See `OccupancyGrid.probes`."""
        return self.grid.probes(step)

    def learn(self, field: RadianceField, probes: Tensor) -> None:
        """See `OccupancyGrid.learn`."""
        self.grid.learn(field, probes)

    def occupied_cells(self, time: float | None) -> OccupiedCells:
        """The cells that images look into at a time, or at any."""
        occupied = self.grid.looked_into(is_narrow=True)[0]
        mask = occupied.any(0) if time is None else occupied[min(int(time * len(occupied)), len(occupied) - 1)]
        return OccupiedCells(self.grid.box, mask)

    def occupied_positions(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """See `OccupancyAware.occupied_positions`; in any cell, if none is occupied."""
        return self.grid.occupied_positions(unit)

    def _jitter(self, rays: Rays, generator: torch.Generator | None) -> Tensor:
        jitter = torch.zeros_like(rays.near)
        return jitter.uniform_(generator=generator) if self.training else jitter

    def first(self, rays: Rays, most: int) -> Samples:
        """In evaluation mode, the first samples of each ray; what lies behind is not marched through."""
        return self._march(rays, torch.zeros_like(rays.near), most)

    @torch.no_grad()
    def refined(
        self, samples: Samples, rays: Rays, field: RadianceField, transmittance: Tensor, min_weight: float
    ) -> tuple[Samples, FieldOutput]:
        """The intervals above `min_weight`, those above `subdivision_weight` cut; as they are, if images cut none.

        What is known is not evaluated again: whole intervals, and parts in whose middle their interval's is.
        """
        known = evaluate_along_rays(field, rays, samples, pad_to=self.pad_to)
        if self.render_subdivision == 1:
            return samples, known
        parts = seen_parts(
            samples.starts, samples.ends, samples.offsets, known.density, transmittance,
            subdivision=self.render_subdivision, subdivision_weight=self.subdivision_weight, min_weight=min_weight,
        )  # fmt: skip
        placed_parts = Samples(
            parts.starts, parts.ends, len(rays), ray_indices=parts.ray_indices, ray_offsets=parts.offsets
        )
        density, rgb = (x.index_select(0, parts.whole) for x in (known.density, known.rgb))
        new = parts.new
        if interval_aware(field) is not None:  # the middle of an interval says nothing of the part in its middle
            new = (parts.whole.bincount()[parts.whole] > 1).nonzero()[:, 0]
        if len(new):
            found = evaluate_along_rays(field, rays, placed_parts.chosen(new), pad_to=self.pad_to)
            density[new], rgb[new] = found.density, found.rgb
        return placed_parts, FieldOutput(density, rgb)

    def path_key(self) -> Hashable:
        """See `FixedCapacity.path_key`."""
        return self.training, self.training_subdivision, self.render_subdivision, self.is_narrow

    @torch.no_grad()
    def sample_fixed(
        self, rays: Rays, field: RadianceField, capacity: Capacity, *, generator: torch.Generator | None = None
    ) -> Samples:
        """Samples in a fixed number of places; all intervals are evaluated for densities at once."""
        min_weight = self.min_weight if capacity.min_weight is None else capacity.min_weight
        intervals, num_marched = march_to_size(
            rays.origins, rays.directions, rays.near, rays.far, times=rays.times, jitter=self._jitter(rays, generator),
            occupancy=self.grid.looked_into(self.is_narrow or not self.training)[0], aabb=self.grid.box,
            step=self.length if self.training else self.length.new_full((), self.step_size), size=capacity.marched,
        )  # fmt: skip
        is_filled = intervals.ends > intervals.starts
        samples = Samples(
            intervals.starts, intervals.ends, len(rays), ray_indices=intervals.ray_indices,
            ray_offsets=intervals.offsets, is_placed=placed(intervals.ray_indices, is_filled, len(rays), num_marched),
        )  # fmt: skip
        density, positions, times = density_of_samples(field, samples, rays)
        if self.training:
            self.observe(positions, times, torch.where(is_filled, density, 0))
        weights = render_weights(interval_depths(density, samples.lengths), samples)
        subdivision = self.training_subdivision if self.training else self.render_subdivision
        is_seen = ~(weights <= min_weight) if min_weight else torch.ones_like(weights, dtype=torch.bool)
        is_seen &= is_filled  # NaN is seen
        if self.training:
            is_seen, samples = self._by_chance(samples, weights, is_seen, field, generator)
        counts = self._counts(weights, subdivision) * is_seen
        samples, num_wanted = samples.fitted(counts, capacity.kept)
        return replace(samples, wanted=torch.stack([num_marched, num_wanted]))

    def _counts(self, weights: Tensor, most: int) -> Tensor:
        """Into how many parts intervals of such weights are cut, int64."""
        return torch.where(weights <= self.subdivision_weight, 1, most)

    def _march(self, rays: Rays, jitter: Tensor, most: int | None = None) -> Samples:
        occupied, skips = self.grid.looked_into(self.is_narrow or not self.training)
        marched = march(
            rays.origins, rays.directions, rays.near, rays.far, times=rays.times, jitter=jitter, occupancy=occupied,
            aabb=self.grid.box, step=self.training_step if self.training else self.step_size, max_samples_per_ray=most,
            skips=skips,
        )  # fmt: skip
        return Samples(
            marched.starts, marched.ends, len(rays), ray_indices=marched.ray_indices, ray_offsets=marched.offsets
        )

    def march_grid(self, time: float, dtype: torch.dtype) -> MarchGrid:
        """The slab that images of a time look into."""
        occupied, skips = self.grid.looked_into(is_narrow=True)
        # It rounds as times of rays do.
        slab = min(int(torch.tensor(time, dtype=dtype) * len(occupied)), len(occupied) - 1)
        return MarchGrid(
            occupied[slab], skips[slab], self.grid.box, self.step_size, self.render_subdivision, self.subdivision_weight
        )

    @torch.no_grad()
    def visible_rays(self, camera: Camera, time: float) -> tuple[Tensor, Rays] | None:
        """Pixels that occupied cells cover, see `footprints`, and their rays; None if that cannot be told.

        So it is if a cell lies beside the camera, or its lens is distorted.

        So a frame costs what the body covers, not what the image holds. Rays begin and end, a whole number of
        intervals away from where they did, before and behind the cells that cover them: their intervals stay, up to
        rounding.
        """
        grid, view = self.march_grid(time, camera.pose.dtype), camera.intrinsics
        if view.distortion is not None:
            return None
        covered = footprints(grid.occupancy, grid.aabb, camera.pose, view.pinhole, (view.height, view.width))
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

    def _visible(
        self, samples: Samples, rays: Rays, field: RadianceField, generator: torch.Generator | None
    ) -> Samples:
        weights = visible_weights(
            samples, rays, field, self.min_weight,
            first_round=FIRST_ROUND, most_at_once=MOST_AT_ONCE, pad_to=self.pad_to, observe=self.observe,
        )  # fmt: skip
        is_visible = ~(weights <= self.min_weight)  # NaN is
        is_visible, samples = self._by_chance(samples, weights, is_visible, field, generator)
        kept, count = samples.kept(is_visible), self.training_subdivision
        return kept if count == 1 else kept.split(self._counts(weights[is_visible], count))

    def _by_chance(
        self, samples: Samples, weights: Tensor, is_visible: Tensor, field: RadianceField,
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Samples]:  # fmt: skip
        """Which of the visible samples (N,) are taken, and all of them, as long as one that is taken counts."""
        if not self.chance_weight or interval_aware(field) is not None:
            return is_visible, samples
        chances = torch.where(weights < self.chance_weight, weights / self.chance_weight, 1)
        is_taken = by_chance(torch.where(is_visible, chances, 0), generator)
        return is_taken, samples.stretched(torch.where(is_taken, 1 / chances, 1))
