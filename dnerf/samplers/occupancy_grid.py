"""Cells over space and slabs of time that learn where something is."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive, check_within
from dnerf.core.geometry import cubes
from dnerf.fields.base import RadianceField
from dnerf.kernels import skip_distances
from dnerf.nn.parameter_groups import HasTrainingBuffers

SPACE = (1, 2, 3)  # axes
PROBES_AT_ONCE = 1 << 18  # of a finished field
NEGLIGIBLE = 1e-4  # density, in 1 / world unit, that no image shows
OPAQUE = 1e4  # as what infinite density counts, and what is no number: samples have to see it, and it can decay


class OccupancyGrid(nn.Module, HasTrainingBuffers):
    """Every cell of every slab of time keeps a decaying maximum of the densities evaluated in it.

    They are those of the training samples themselves (free) and of random probes of the field. A cell is occupied while
    it, or a neighbour in space or time, is above the smaller of `threshold` and half the mean of all cells. So a thin
    start empties nothing that was looked at (uniform density is above half its mean), empty space is dropped as soon as
    something stands out, and neighbours and probes bring back what was lost or lies where nobody has looked yet.

    Sources: instant-ngp (Mueller et al. 2022, appendix C) for the decaying maximum, nerfacc for a threshold that
    follows the mean; slabs in time and the use of training samples are this project's.

    Args:
        box: (2, 3) corners of the space that is sampled, in world units.
        resolution: cells along the box's longest side; cells are nearly cubes.
        num_slabs: slabs that time is cut into, K.
        threshold: density, in 1 / world unit, above which a cell is occupied.
        decay: factor on all maxima at each update.
        update_every: training steps between updates.
        num_probes: random cells evaluated at each update.
        dilation: cells by which occupied regions are widened in space (0 or 1); time is widened by one slab, and in
            evaluation, if `render_dilation` differs, by the nearer half of one.
        render_dilation: the same in evaluation mode. Training needs it, for bodies to move into; images of a trained
            field hardly do, and it is half of their samples. `fill` always takes `dilation`.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self, box: Sequence[Sequence[float]], resolution: int = 64, *, num_slabs: int = 16, threshold: float = 1.0,
        decay: float = 0.8, update_every: int = 16, num_probes: int = 1 << 16, dilation: int = 1,
        render_dilation: int = 1,
    ) -> None:  # fmt: skip
        super().__init__()
        for name, value in (
            ("resolution", resolution), ("num_slabs", num_slabs), ("threshold", threshold),
            ("update_every", update_every), ("num_probes", num_probes),
        ):  # fmt: skip
            check_positive(name, value)
        check_within("decay", decay, "(0, 1)")
        for name, value in (("dilation", dilation), ("render_dilation", render_dilation)):
            if value not in (0, 1):
                raise ValueError(f"{name} must be 0 or 1, got {value}")
        corners = as_box(box)
        cells = cubes(corners, resolution)
        self.threshold, self.decay = threshold, decay
        self.update_every, self.num_probes = update_every, num_probes
        self.dilation, self.render_dilation = dilation, render_dilation
        self.box = nn.Buffer(corners, persistent=False)
        self.shape = nn.Buffer(torch.tensor([num_slabs, *cells]), persistent=False)
        self.strides = nn.Buffer(torch.tensor(torch.empty(num_slabs, *cells).stride()), persistent=False)
        self.maxima = nn.Buffer(torch.full((num_slabs, *cells), NEGLIGIBLE * 1e-3))
        self.occupied = nn.Buffer(torch.ones((num_slabs, *cells), dtype=torch.bool))
        self.skips = nn.Buffer(skip_distances(self.occupied), persistent=False)
        # Two for each slab: the earlier half is widened by the slab before, the later one by the slab after.
        halves = torch.ones((2 * num_slabs, *cells), dtype=torch.bool) if render_dilation != dilation else None
        self.register_buffer("rendered", halves)
        self.register_buffer("rendered_skips", None if halves is None else skip_distances(halves), persistent=False)
        self.register_load_state_dict_post_hook(_derive)
        self.rendered: Tensor | None
        self.rendered_skips: Tensor | None
        self._cells: Tensor | None = None  # numbers of the occupied ones, once wanted

    def training_buffers(self) -> tuple[str, ...]:
        """The maxima, and what training marches through if images do not."""
        return ("maxima",) if self.rendered is None else ("maxima", "occupied")

    def looked_into(self, is_narrow: bool) -> tuple[Tensor, Tensor]:
        """Occupied cells, those of images or those of training, and their skips."""
        if is_narrow and self.rendered is not None and self.rendered_skips is not None:
            return self.rendered, self.rendered_skips
        return self.occupied, self.skips

    @torch.no_grad()
    def occupied_positions(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and times in occupied cells (in any, if none is), see `OccupancyAware`."""
        if unit.is_cuda:
            return self._within(spread_over(self.occupied, unit[:, 0]), unit[:, 1:])
        if self._cells is None:
            cells = self.occupied.view(-1).nonzero()[:, 0]
            self._cells = cells if len(cells) else torch.arange(self.occupied.numel())
        return self._within(self._cells[(unit[:, 0] * len(self._cells)).long()], unit[:, 1:])

    @torch.no_grad()
    def observe(self, positions: Tensor, times: Tensor, density: Tensor) -> None:
        """Enter the densities of training samples, all (N, ...), into the grid."""
        unit = (positions - self.box[0]) / (self.box[1] - self.box[0])
        cells = torch.cat([times[:, None], unit], dim=-1) * self.shape
        cells = torch.minimum(cells.long().clamp_(min=0), self.shape - 1)
        flat = (cells * self.strides).sum(-1)
        self._enter(flat, density)

    def probes(self, step: int) -> Tensor | None:
        """Every `update_every` steps, numbers (num_probes, 5) in [0, 1): which cell, and where in it."""
        if step == 0 or step % self.update_every:
            return None
        device = self.maxima.device
        generator = torch.Generator(device).manual_seed(step)
        # float32 has 2^24 numbers there, and there may be more cells.
        return torch.rand(self.num_probes, 5, generator=generator, device=device, dtype=torch.float64)

    @torch.no_grad()
    def learn(self, field: RadianceField, probes: Tensor) -> None:
        """Probe cells of the field, and decide anew which are occupied."""
        cells = (probes[:, 0] * self.maxima.numel()).long()
        self.maxima.mul_(self.decay).clamp_(min=NEGLIGIBLE * 1e-3)
        self._probe(field, cells, probes[:, 1:].to(self.box.dtype))
        self.decide()

    @torch.no_grad()
    def fill(self, field: RadianceField, probes_per_cell: int = 8) -> None:
        """Learn a finished field: forget everything, probe every cell at random points, decide what is occupied.

        The image then differs from the one without occupancy by what lies in cells whose probes (and neighbours')
        are all below the threshold: at most `1 - exp(-threshold * length)` where the field is that thin.
        """
        self.maxima.fill_(NEGLIGIBLE * 1e-3)
        device = self.maxima.device
        generator = torch.Generator(device).manual_seed(0)
        for _ in range(probes_per_cell):
            for cells in torch.arange(self.maxima.numel(), device=device).split(PROBES_AT_ONCE):
                self._probe(field, cells, torch.rand(len(cells), 4, generator=generator, device=device))
        self.decide(is_filled=True)

    def decide(self, *, is_filled: bool = False) -> None:
        """Decide from the maxima, which may be those of a finished field (`fill`), which cells are occupied."""
        threshold = (0.5 * self.maxima.mean()).clamp(NEGLIGIBLE, self.threshold)
        dense = self.maxima > threshold
        occupied = widened(widened(dense, [0]), SPACE if self.dilation else [])
        if is_filled or self.rendered is None:
            self._set(occupied, occupied.repeat_interleave(2, dim=0))
        else:
            self._set(occupied, widened(slab_halves(dense), SPACE if self.render_dilation else []))

    def _probe(self, field: RadianceField, cells: Tensor, within: Tensor) -> None:
        self._enter(cells, field.density(*self._within(cells, within)))

    def _enter(self, cells: Tensor, density: Tensor) -> None:
        known = density.to(self.maxima.dtype).nan_to_num(nan=OPAQUE, posinf=OPAQUE)
        self.maxima.view(-1).scatter_reduce_(0, cells, known, "amax")

    def _within(self, cells: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (N, 3) and times (N,) at places (N, 4) in [0, 1] within cells (N,)."""
        unit = (cells[:, None] // self.strides % self.shape + within) / self.shape
        return torch.lerp(self.box[0], self.box[1], unit[:, 1:]), unit[:, 0]

    @torch.no_grad()
    def occupy(self, mask: Tensor) -> None:
        """Say by a mask (K, Gx, Gy, Gz), or what broadcasts to it, which cells are occupied."""
        mask = mask.expand(self.occupied.shape)
        self._set(mask, mask.repeat_interleave(2, dim=0))

    def _set(self, occupied: Tensor, rendered: Tensor) -> None:
        self.occupied.copy_(occupied)
        if self.rendered is not None:
            self.rendered.copy_(rendered)
        _derive(self)


def _derive(module: nn.Module, incompatible_keys: object = None) -> None:
    """Derive what is not saved from the occupied cells: a grid's skips; their list on demand."""
    grid = cast(OccupancyGrid, module)
    grid._cells = None
    grid.skips.copy_(skip_distances(grid.occupied))
    if grid.rendered is not None and grid.rendered_skips is not None:
        grid.rendered_skips.copy_(skip_distances(grid.rendered))


def widened(mask: Tensor, axes: Sequence[int]) -> Tensor:
    """A mask and its neighbours on both sides along some axes."""
    for axis in axes:
        result, size = mask.clone(), mask.shape[axis] - 1
        result.narrow(axis, 1, size).logical_or_(mask.narrow(axis, 0, size))
        result.narrow(axis, 0, size).logical_or_(mask.narrow(axis, 1, size))
        mask = result
    return mask


def slab_halves(mask: Tensor) -> Tensor:
    """A mask (K, ...) for halves of its slabs (2 K, ...), each with the neighbour that is nearer in time."""
    before, after = torch.cat([mask[:1], mask[:-1]]), torch.cat([mask[1:], mask[-1:]])
    return torch.stack([mask | before, mask | after], dim=1).flatten(0, 1)


def spread_over(mask: Tensor, unit: Tensor) -> Tensor:
    """Numbers (N,) of the places of a mask that hold, for shares (N,) in [0, 1) of all of those; of any if none holds.

    It reads nothing from a device, unlike a list of those places.
    """
    numbers = mask.view(-1).cumsum(0)
    found = torch.searchsorted(numbers, (unit * numbers[-1]).long(), right=True)
    return torch.where(numbers[-1] > 0, found, (unit * len(numbers)).long()).clamp(max=len(numbers) - 1)
