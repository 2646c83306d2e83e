"""A flow that is integrated only where matter moves."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from dnerf.checks import as_box, check_positive
from dnerf.deformations.base import InvertibleDeformation, check_positions_times
from dnerf.deformations.flow_chain import Flow


class SkippingFlow(InvertibleDeformation):
    """A flow that leaves samples alone where it has hardly moved any of late.

    A coarse grid keeps a decaying maximum of how far the flow moved training samples from each cell, at any time.
    Samples in cells (and neighbours of cells) above the threshold are integrated; of the others every eighth is in
    training, so that motion that begins anywhere is noticed. Worth it for scenes with much still matter.

    A skipped sample is off by about the threshold at most, so the map jumps by that much where cells change, and
    the round trip is exact to the threshold only.

    Args:
        flow: what is integrated.
        box: (2, 3) corners of the grid, in world units.
        resolution: cells along the box's longest side.
        threshold: displacement below which a cell counts as still, in world units.
        decay: factor on all maxima at each call in training, in (0, 1).
        explore_every: one of so many samples in still cells is integrated in training.
        pad_to: the number of integrated samples is rounded up to a multiple of this, since matrix libraries compile
            code for every new number of rows.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        flow: Flow,
        box: Sequence[Sequence[float]],
        resolution: int = 32,
        *,
        threshold: float = 2e-3,
        decay: float = 0.98,
        explore_every: int = 8,
        pad_to: int = 2048,
    ) -> None:
        super().__init__()
        for name, value in (
            ("resolution", resolution),
            ("threshold", threshold),
            ("explore_every", explore_every),
            ("pad_to", pad_to),
        ):
            check_positive(name, value)
        if not 0 < decay < 1:
            raise ValueError(f"decay must be in (0, 1), got {decay}")
        corners = as_box(box)
        sides = corners[1] - corners[0]
        cells = [max(1, round(resolution * float(s / sides.max()))) for s in sides]
        self.flow = flow
        self.threshold = threshold
        self.decay = decay
        self.explore_every = explore_every
        self.pad_to = pad_to
        self.num_integrated = 0
        self.register_buffer("low", corners[0], persistent=False)
        self.register_buffer("scale", torch.tensor(cells) / sides, persistent=False)
        self.register_buffer("cells", torch.tensor(cells), persistent=False)
        # All cells count as moving until they have been looked at.
        self.register_buffer("motion", torch.full(cells, float(sides.max())))
        self.low: Tensor
        self.scale: Tensor
        self.cells: Tensor
        self.motion: Tensor

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,); raises as the flow does.

        `num_integrated` afterwards says how many samples were integrated. Training mode updates the grid.
        """
        check_positions_times(positions, times)
        points, moments = positions.reshape(-1, 3), times.reshape(-1)
        cells = self._cells(points)
        moving = self._moving(cells)
        if self.training:
            moving[:: self.explore_every] = True
        indices = moving.nonzero()[:, 0]
        self.num_integrated = len(indices)
        if not len(indices):
            return positions
        padded = torch.cat([indices, indices[-1:].expand(-len(indices) % self.pad_to)])
        carried = self.flow(points[padded], moments[padded])[: len(indices)]
        if self.training:
            self._observe(cells[indices], carried.detach() - points[indices].detach())
        return points.index_copy(0, indices, carried).reshape(positions.shape)

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3)."""
        world = self.flow.inverse(canonical, times)
        moving = self._moving(self._cells(world.detach().reshape(-1, 3))).reshape(times.shape)
        return torch.where(moving[..., None], world, canonical)

    def _cells(self, points: Tensor) -> Tensor:
        """Flat cell index (N,) of points (N, 3); those outside belong to the nearest cell."""
        index = ((points.detach() - self.low) * self.scale).long().clamp_(min=0)
        x, y, z = torch.minimum(index, self.cells - 1).unbind(-1)
        return (x * self.motion.shape[1] + y) * self.motion.shape[2] + z

    def _moving(self, cells: Tensor) -> Tensor:
        near = functional.max_pool3d(self.motion[None, None], 3, stride=1, padding=1)
        return near.reshape(-1)[cells] > self.threshold

    @torch.no_grad()
    def _observe(self, cells: Tensor, displacements: Tensor) -> None:
        self.motion.mul_(self.decay)
        self.motion.view(-1).scatter_reduce_(0, cells, displacements.norm(dim=-1).to(self.motion.dtype), "amax")
