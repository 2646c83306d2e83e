"""Cells over space and slabs of time that learn where matter is."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import as_box, check_positive
from dnerf.fields.base import RadianceField
from dnerf.kernels import skip_distances
from dnerf.samplers.base import Sampler
from dnerf.samplers.masks import slab_halves, spread_over, widened

SPACE = (1, 2, 3)  # axes
NEGLIGIBLE = 1e-4  # density, in 1 / world unit, that no picture shows
OPAQUE = 1e4  # as what infinite density counts, and what is no number: samples have to see it, and it can decay


class OccupancyGrid(Sampler):
    """What a sampler that looks only where matter is knows of it; how it places samples is left to `OccupancySampler`,
    which describes the arguments and how cells become occupied.

    Raises:
        ValueError: for numbers out of range.
    """

    observed = ("maxima",)

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        resolution: int,
        *,
        num_slabs: int,
        threshold: float,
        decay: float,
        update_every: int,
        num_probes: int,
        margin: int,
        render_margin: int,
    ) -> None:
        super().__init__()
        for name, value in (
            ("resolution", resolution),
            ("num_slabs", num_slabs),
            ("threshold", threshold),
            ("update_every", update_every),
            ("num_probes", num_probes),
        ):
            check_positive(name, value)
        if not 0 < decay < 1:
            raise ValueError(f"decay must be in (0, 1), got {decay}")
        for name, value in (("margin", margin), ("render_margin", render_margin)):
            if value not in (0, 1):
                raise ValueError(f"{name} must be 0 or 1, got {value}")
        corners = as_box(box)
        sides = corners[1] - corners[0]
        cells = [max(1, round(resolution * float(s / sides.max()))) for s in sides]
        self.threshold = threshold
        self.decay = decay
        self.update_every = update_every
        self.num_probes = num_probes
        self.margin = margin
        self.render_margin = render_margin
        self.register_buffer("box", corners, persistent=False)
        self.register_buffer("shape", torch.tensor([num_slabs, *cells]), persistent=False)
        self.register_buffer("strides", torch.tensor(torch.empty(num_slabs, *cells).stride()), persistent=False)
        self.register_buffer("maxima", torch.full((num_slabs, *cells), NEGLIGIBLE * 1e-3))
        self.register_buffer("occupied", torch.ones((num_slabs, *cells), dtype=torch.bool))
        self.register_buffer("skips", skip_distances(self.occupied), persistent=False)
        has_own = render_margin != margin
        # Two for each slab: the earlier half is widened by the slab before, the later one by the slab after.
        halves = torch.ones((2 * num_slabs, *cells), dtype=torch.bool) if has_own else None
        self.register_buffer("rendered", halves)
        self.register_buffer("rendered_skips", None if halves is None else skip_distances(halves), persistent=False)
        self.register_load_state_dict_post_hook(_derive)
        self.box: Tensor
        self.shape: Tensor
        self.strides: Tensor
        self.skips: Tensor
        self.maxima: Tensor
        self.occupied: Tensor
        self.rendered: Tensor | None
        self.rendered_skips: Tensor | None
        self._cells: Tensor | None = None  # numbers of the occupied ones, once asked for

    @property
    def share(self) -> float:
        """Share of the cells that pictures look into."""
        return float((self.occupied if self.rendered is None else self.rendered).float().mean())

    def cells_at_any_time(self) -> tuple[Tensor, Tensor]:
        """See `Sampler.cells_at_any_time`."""
        return self.box, self.looked_into(is_narrow=True)[0].any(0)

    def looked_into(self, is_narrow: bool) -> tuple[Tensor, Tensor]:
        """Occupied cells, those of pictures or those of training, and their skips."""
        if is_narrow and self.rendered is not None and self.rendered_skips is not None:
            return self.rendered, self.rendered_skips
        return self.occupied, self.skips

    @torch.no_grad()
    def places(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and times in occupied cells (in any, if none is), see `Sampler.places`."""
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
    def fill(self, field: RadianceField, probes_per_cell: int = 8, *, chunk: int = 1 << 18) -> None:
        """Learn a finished field: forget everything, probe every cell at random points, decide what is occupied.

        The picture then differs from the one without occupancy by what lies in cells whose probes (and neighbours')
        are all below the threshold: at most `1 - exp(-threshold * length)` where the field is that thin.

        Args:
            field: trained or analytic.
            probes_per_cell: random points of each cell and slab.
            chunk: probes at a time.
        """
        self.maxima.fill_(NEGLIGIBLE * 1e-3)
        device = self.maxima.device
        generator = torch.Generator(device).manual_seed(0)
        for _ in range(probes_per_cell):
            for cells in torch.arange(self.maxima.numel(), device=device).split(chunk):
                self._probe(field, cells, torch.rand(len(cells), 4, generator=generator, device=device))
        self.decide(is_filled=True)

    def decide(self, *, is_filled: bool = False) -> None:
        """Decide from the maxima which cells are occupied; `fill` and `update` do so themselves.

        Args:
            is_filled: whether the maxima are those of a finished field, see `fill`.
        """
        threshold = (0.5 * self.maxima.mean()).clamp(NEGLIGIBLE, self.threshold)
        dense = self.maxima > threshold
        occupied = widened(widened(dense, [0]), SPACE if self.margin else [])
        if is_filled or self.rendered is None:
            self._set(occupied, occupied.repeat_interleave(2, dim=0))
        else:
            self._set(occupied, widened(slab_halves(dense), SPACE if self.render_margin else []))

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
        """Say which cells are occupied, in training and in evaluation.

        Args:
            mask: (K, Gx, Gy, Gz) bool, or what broadcasts to it.
        """
        mask = mask.expand(self.occupied.shape)
        self._set(mask, mask.repeat_interleave(2, dim=0))

    def _set(self, occupied: Tensor, rendered: Tensor) -> None:
        self.occupied.copy_(occupied)
        if self.rendered is not None:
            self.rendered.copy_(rendered)
        _derive(self)


def _derive(grid: nn.Module, incompatible_keys: object = None) -> None:
    """Derive what is not saved from the occupied cells: a grid's skips; their list on demand."""
    assert isinstance(grid, OccupancyGrid)
    grid._cells = None
    grid.skips.copy_(skip_distances(grid.occupied))
    if grid.rendered is not None and grid.rendered_skips is not None:
        grid.rendered_skips.copy_(skip_distances(grid.rendered))
