"""Values on a regular lattice over space and time, interpolated at positions that each have their own time."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.checks import as_box, check_positive
from dnerf.kernels import GridLevels, grid_encode


class SpaceTimeLattice(nn.Module):
    """The geometry of a lattice: vertices over a box, knots over the times [0, 1], linear interpolation in all four.

    The three-dimensional `grid_encode` does the work: the lattices of neighbouring knots stand on top of each other
    along z, and each row holds the values of its knot and the next.

    Args:
        box: (2, 3) lowest and highest corner, in world units.
        resolution: cells along the box's longest side; cells are nearly cubes.
        num_knots: times at which values stand, K >= 2, evenly from 0 to 1.

    Raises:
        ValueError: for a box that is none or numbers out of range.
    """

    def __init__(self, box: Sequence[Sequence[float]], resolution: int, num_knots: int) -> None:
        super().__init__()
        check_positive("resolution", resolution)
        if num_knots < 2:
            raise ValueError(f"num_knots must be at least 2, got {num_knots}")
        corners = as_box(box)
        sides = corners[1] - corners[0]
        self.cells = [max(1, round(resolution * float(s / sides.max()))) for s in sides]
        self.num_knots = num_knots
        self.num_vertices = (self.cells[0] + 1) * (self.cells[1] + 1) * (self.cells[2] + 1)
        stacked = (num_knots - 1) * (self.cells[2] + 1) - 1
        rows = (num_knots - 1) * self.num_vertices
        self.levels = GridLevels([[self.cells[0], self.cells[1], stacked]], 1 << (rows - 1).bit_length())
        self.register_buffer("low", corners[0], persistent=False)
        self.register_buffer("sides", sides, persistent=False)
        self.low: Tensor
        self.sides: Tensor

    def locate(self, positions: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        """Where to look: stacked positions (N, 3) in [0, 1] and the fraction (N, 1) between a knot and the next.

        Args:
            positions: (N, 3) in world units; those outside the box count as on its faces.
            times: (N,); those outside [0, 1] count as 0 or 1.
        """
        precise = torch.promote_types(positions.dtype, torch.float32)  # knots times layers have no room in half of it
        positions, times = positions.to(precise), times.to(precise)
        scaled = times.clamp(0, 1) * (self.num_knots - 1)
        knots = scaled.detach().floor().clamp(max=self.num_knots - 2)
        unit = ((positions - self.low.to(positions.dtype)) / self.sides.to(positions.dtype)).clamp(0, 1)
        layers = self.cells[2] + 1
        z = (knots * layers + unit[:, 2] * self.cells[2]) / ((self.num_knots - 1) * layers - 1)
        return torch.cat([unit[:, :2], z[:, None]], dim=-1), (scaled - knots)[:, None]

    def pairs(self, values: Tensor) -> Tensor:
        """The table of values (K, V, F) that `interpolate` reads, ((K - 1) V, 2 F)."""
        return torch.cat([values[:-1], values[1:]], dim=-1).reshape(-1, 2 * values.shape[-1])

    def interpolate(self, pairs: Tensor, located: tuple[Tensor, Tensor]) -> Tensor:
        """Values (N, F) from the table of `pairs` at what `locate` returned."""
        before, after = grid_encode(located[0], pairs, self.levels).chunk(2, dim=-1)
        return torch.lerp(before, after, located[1].to(before.dtype))

    def touched(self, located: tuple[Tensor, Tensor]) -> Tensor:
        """Which vertices the positions' values depend on, (K, V) bool."""
        nx, ny, nz = (c + 1 for c in self.cells)
        cells = self.levels.cells
        size = torch.tensor(cells, device=located[0].device)
        lower = (located[0].detach() * size.to(located[0].dtype)).long().clamp(max=size - 1)
        # Rounding can put a point of a knot's top face below the next knot's first layer, where no cell is.
        knots = (lower[:, 2] // nz).clamp(max=self.num_knots - 2)
        layer = lower[:, 2] - knots * nz
        mask = torch.zeros(self.num_knots, nz, ny, nx, dtype=torch.bool, device=located[0].device)
        mask[knots, layer, lower[:, 1], lower[:, 0]] = True
        for axis in range(4):
            moved = mask.clone()
            moved.narrow(axis, 1, mask.shape[axis] - 1).logical_or_(mask.narrow(axis, 0, mask.shape[axis] - 1))
            mask = moved
        return mask.reshape(self.num_knots, -1)

    def place(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (M, 3) and times (M,) of vertices given by flat index (M,) into (K, V)."""
        nx, ny = self.cells[0] + 1, self.cells[1] + 1
        knots, vertex = indices // self.num_vertices, indices % self.num_vertices
        grid = torch.stack([vertex % nx, vertex // nx % ny, vertex // (nx * ny)], dim=-1)
        unit = grid / torch.tensor(self.cells, device=indices.device)
        return self.low + self.sides * unit, knots / (self.num_knots - 1)
