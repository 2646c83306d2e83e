"""Velocity from a grid over space and time, with no network or a tiny one."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from dnerf.deformations.space_time import SpaceTimeLattice
from dnerf.deformations.velocities.base import BoxWindow, Velocity
from dnerf.mlp import MLP

LANES = 4
"""Numbers per vertex: three and one of padding, for the kernel's vector instructions."""


class GridVelocity(Velocity):
    """v(x, t) = w(x) times what a regular grid over space and time says, linear between its vertices.

    Cheap, and zero everywhere at initialisation. It is continuous but not smooth: fixed-step solvers come down to
    order two or less across cells, so it wants few steps rather than high orders.

    Args:
        box: (2, 3) corners outside of which nothing moves, in world units.
        resolution: cells along the box's longest side.
        num_knots: times at which values stand, evenly from 0 to 1.
        hidden_features: None reads velocities from the grid; a number reads features, and a network with one hidden
            layer of that width makes velocities of them.
        num_features: features per vertex with a network.
        margin: see `BoxWindow`.
        smoothness: see `BoxWindow`.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        box: Sequence[Sequence[float]],
        resolution: int = 16,
        num_knots: int = 17,
        *,
        hidden_features: int | None = None,
        num_features: int = 8,
        margin: float = 0.1,
        smoothness: int = 1,
    ) -> None:
        super().__init__()
        self.window = BoxWindow(box, margin, smoothness)
        self.lattice = SpaceTimeLattice(box, resolution, num_knots)
        shape = (num_knots, self.lattice.num_vertices, LANES if hidden_features is None else num_features)
        self.values = nn.Parameter(torch.zeros(shape))
        self.network: MLP | None = None
        if hidden_features is not None:
            nn.init.uniform_(self.values, -1e-1, 1e-1)
            self.network = MLP(num_features, hidden_features, 1, out_features=3, zero_output=True)

    def rest(self) -> None:
        """Be zero again, as at initialisation; features of a network stay as they are."""
        if self.network is None:
            nn.init.zeros_(self.values)

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3) at positions (..., 3) and times (...,); times outside [0, 1] count as 0 or 1."""
        return self.at(times)(positions)

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        """The field at fixed times, the table of neighbouring knots made once."""
        pairs = self.lattice.pairs(self.values)

        def velocity(positions: Tensor) -> Tensor:
            located = self.lattice.locate(positions.reshape(-1, 3), times.reshape(-1))
            read = self.lattice.interpolate(pairs, located)
            read = read[:, :3] if self.network is None else self.network(read)
            return self.window(positions) * read.reshape(positions.shape).to(positions.dtype)

        return velocity
