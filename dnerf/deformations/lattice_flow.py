"""A flow map on a coarse lattice of space and time: integrate the vertices, interpolate the samples."""

from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.deformations.base import InvertibleDeformation, check_positions_times
from dnerf.deformations.fixed_point import attach_gradient, invert
from dnerf.deformations.flow_chain import Flow
from dnerf.deformations.space_time import SpaceTimeLattice


class LatticeFlow(InvertibleDeformation):
    """A flow seen through a lattice: displacements are exact at vertices and linear in between.

    Only the vertices next to a sample are integrated, once each, however many samples share them: matter fills a
    small part of space, and a picture has one time. So a deep solver costs little per sample. Nothing is kept between
    calls; gradients pass through the vertices. The map is the flow's up to interpolation; its inverse is found from
    the flow's inverse by the fixed-point iteration of `invert`, and exists while cells are not turned inside out.

    Args:
        flow: what is integrated.
        box: (2, 3) corners of the lattice; matter outside moves as the nearest face does: not at all where that is
            the velocity's own box.
        resolution: cells along the box's longest side.
        num_knots: times at which the flow is integrated, evenly from 0 to 1.
        pad_to: the number of vertices is rounded up to a multiple of this, since matrix libraries compile code for
            every new number of rows.
        num_iterations: of the inverse.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        flow: Flow,
        box: Sequence[Sequence[float]],
        resolution: int = 24,
        num_knots: int = 33,
        *,
        pad_to: int = 2048,
        num_iterations: int = 12,
    ) -> None:
        super().__init__()
        check_positive("pad_to", pad_to)
        check_positive("num_iterations", num_iterations)
        self.flow = flow
        self.lattice = SpaceTimeLattice(box, resolution, num_knots)
        self.pad_to = pad_to
        self.num_iterations = num_iterations
        self.num_vertices = 0

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,); raises as the flow does.

        `num_vertices` afterwards says how many vertices were integrated.
        """
        check_positions_times(positions, times)
        if not positions.numel():
            return positions
        located = self.lattice.locate(positions.reshape(-1, 3), times.reshape(-1))
        indices = self.lattice.touched(located).reshape(-1).nonzero()[:, 0]
        self.num_vertices = len(indices)
        padded = torch.cat([indices, indices[-1:].expand(-len(indices) % self.pad_to)])
        vertices, knots = self.lattice.place(padded)
        vertices, knots = vertices.to(positions.dtype), knots.to(positions.dtype)
        moved = (self.flow(vertices, knots) - vertices)[: len(indices)]
        values = moved.new_zeros(self.lattice.num_knots * self.lattice.num_vertices, 4)
        values = values.index_put((indices,), torch.nn.functional.pad(moved, (0, 1)))
        pairs = self.lattice.pairs(values.reshape(self.lattice.num_knots, -1, 4))
        read = self.lattice.interpolate(pairs, located)[:, :3].to(positions.dtype)
        return positions + read.reshape(positions.shape)

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        """World positions (..., 3) at times (...,) of canonical positions (..., 3)."""
        check_positions_times(canonical, times)
        if not canonical.numel():
            return canonical
        with torch.no_grad():
            guess = self.flow.inverse(canonical, times)
        world = invert(self, canonical, times, guess=guess, num_iterations=self.num_iterations)[0]
        return attach_gradient(self, world, canonical, times) if torch.is_grad_enabled() else world
