"""A deformation at one time, kept on a lattice: what a whole frame needs of it is computed once."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dnerf.checks import as_box, check_positive
from dnerf.deformations.base import Deformation, check_one_time, check_positions_times
from dnerf.kernels import GridLevels, MarchGrid, covered_places, few_nonzero, grid_encode, lattice_places
from dnerf.rays import Rays

LEAST_ROWS = 256  # fewer take matrix libraries as long
FEW_POINTS = 1024  # whose cells' vertices are listed, not marked in the whole lattice
MOST_AT_ONCE = 1 << 16  # vertices: bounds the memory of networks
VERTICES_PER_RAY = 4  # most to ask around all occupied cells, instead of finding out which of them rays want

Additions = Callable[[Tensor, Tensor], Tensor]
"""Four numbers (M, 4) of canonical positions (M, 3) at times (M,)."""


class FrameLattice:
    """The geometry of lattices that stand in for a deformation while a frame is rendered.

    A frame has one time, and displacements vary slowly in space: a lattice of them costs a few thousand evaluations,
    its samples would cost hundreds of thousands. The map is exact at vertices and linear in between, so the error
    falls with the square of the cells' size.

    Args:
        box: (2, 3) corners of the lattice, in world units; outside it the deformation itself is asked.
        resolution: cells along the box's longest side; cells are nearly cubes.

    Raises:
        ValueError: for a box that is none or a resolution that is not positive.
    """

    def __init__(self, box: Sequence[Sequence[float]], resolution: int = 64) -> None:
        check_positive("resolution", resolution)
        self.box = as_box(box)
        sides = self.box[1] - self.box[0]
        self.cells = [max(1, round(resolution * float(s / sides.max()))) for s in sides]

    def at_time(self, deformation: Deformation, time: float, extent: Tensor | None = None) -> "FrozenDeformation":
        """A stand-in for the deformation at one time, in [0, 1]; if a box (2, 3) is given, for what lies in it."""
        return FrozenDeformation(deformation, self, time, extent)

    def faces(self, extent: Tensor | None = None) -> list[Tensor]:
        """Where vertices are on each axis, at least two; only those of cells that reach into a box (2, 3), if given."""
        faces = []
        for axis, cells in enumerate(self.cells):
            low, side = self.box[0, axis], self.box[1, axis] - self.box[0, axis]
            first, end = 0, cells
            if extent is not None:
                places = ((extent[:, axis].cpu() - low) / side * cells).clamp(0, cells)
                first = min(int(places[0]), cells - 1)
                end = max(math.ceil(places[1]), first + 1)
            faces.append(low + side * torch.arange(first, end + 1) / cells)
        return faces


class FrozenDeformation(Deformation):
    """A deformation at one time, seen through a lattice that is filled where positions fall; see `FrameLattice`.

    For rendering: what was computed once is kept, so it knows nothing of later changes of the deformation, and no
    gradient reaches the deformation.

    Args:
        deformation: what is asked at vertices.
        lattice: where they are.
        time: in [0, 1]; the only one at which it may be called.
        extent: (2, 3), the part of the lattice's box that is wanted, in world units; None for all. The smaller, the
            nearer to the processor its tables stay. Outside, the deformation itself is asked.
        pad_to: the number of vertices asked is rounded up to a multiple of this, or to a power of two below it, since
            matrix libraries compile code for every new number of rows.
    """

    def __init__(
        self,
        deformation: Deformation,
        lattice: FrameLattice,
        time: float,
        extent: Tensor | None = None,
        *,
        pad_to: int = 2048,
    ) -> None:
        super().__init__()
        self.deformation = deformation
        self.time = time
        self.pad_to = pad_to
        self.faces = lattice.faces(extent)
        num_vertices = math.prod(len(x) for x in self.faces)
        self.levels = GridLevels([[len(x) - 1 for x in self.faces]], 1 << (num_vertices - 1).bit_length())
        self.low = torch.stack([x[0] for x in self.faces])
        self.sides = torch.stack([x[-1] for x in self.faces]) - self.low
        self.additions: Additions | None = None
        self.displacements = torch.full((num_vertices, 4), torch.nan)  # four, so that rows are aligned
        self.is_known = torch.zeros([len(x) for x in reversed(self.faces)], dtype=torch.bool)

    def also_keep(self, additions: Additions) -> None:
        """Begin anew, with `displacements` of eight columns: the last four are of a vertex's place in canonical space.

        Args:
            additions: four numbers of places and times, for whoever reads that table; positions are mapped as before.
        """
        self.additions = additions
        self.displacements = self.displacements.new_full((len(self.displacements), 8), torch.nan)
        self.is_known.zero_()

    @torch.no_grad()
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of world positions (..., 3) at times (...,).

        Raises:
            ValueError: for times other than the lattice's.
        """
        check_positions_times(positions, times)
        if not positions.numel():
            return positions
        check_one_time(times, self.time)
        self.move_to(positions.device)
        points = positions.reshape(-1, 3)
        precise = points.to(torch.promote_types(points.dtype, torch.float32))  # as the lookup's own
        unit = (precise - self.low.to(precise.dtype)) / self.sides.to(precise.dtype)
        displacements = grid_encode(unit, self.displacements, self.levels)[:, :3]
        lacks = displacements[:, 0].isnan()
        if bool(lacks.any()):
            self._fill(unit[lacks])
            displacements[lacks] = grid_encode(unit[lacks], self.displacements, self.levels)[:, :3]
        moved = points + displacements.to(points.dtype)
        low, high = unit.aminmax()
        if not bool((low >= 0) & (high <= 1)):
            rest = ~((unit >= 0) & (unit <= 1)).all(-1)
            moved[rest] = self.deformation(points[rest], times.reshape(-1)[rest]).to(moved.dtype)
        return moved.reshape(positions.shape)

    @torch.no_grad()
    def along(self, rays: Rays, ray_indices: Tensor, distances: Tensor) -> Tensor:
        """Canonical positions (N, 3) at distances (N,), in world units, along the rays with numbers (N,) int64.

        Raises:
            ValueError: for rays of other times than the lattice's.
        """
        check_one_time(rays.times, self.time)
        self.move_to(distances.device)
        canonical = lattice_places(
            rays.origins, rays.directions, ray_indices, distances, self.displacements, self.is_known.shape, self.low,
            self.sides,
        )  # fmt: skip
        if not bool(canonical.sum().isfinite()):  # one sum is quicker than looking at each
            rest = few_nonzero(canonical[:, 0].isnan())
            positions, _, times = rays.places(ray_indices[rest], distances[rest])
            canonical[rest] = self(positions, times).to(canonical.dtype)
        return canonical

    def move_to(self, device: torch.device) -> None:
        """Have what is kept on a device."""
        if self.displacements.device != device:
            self.low, self.sides = self.low.to(device), self.sides.to(device)
            self.faces = [x.to(device) for x in self.faces]
            self.displacements, self.is_known = self.displacements.to(device), self.is_known.to(device)

    def _fill(self, unit: Tensor) -> None:
        """Ask the deformation at the vertices of the points' cells that are not known yet."""
        size = torch.tensor(self.levels.cells, device=unit.device)
        # What is no number, or beyond those of a long, becomes the least long, and cell 0.
        x, y, z = torch.minimum((unit * size).long().clamp_(min=0), size - 1).unbind(-1)
        _, rows, columns = self.is_known.shape
        lowest = x.add(y.add(z, alpha=rows), alpha=columns)
        if len(unit) <= FEW_POINTS:
            steps = [(k & 1) + columns * ((k >> 1 & 1) + rows * (k >> 2)) for k in range(8)]
            around = (lowest[:, None] + torch.tensor(steps, device=unit.device)).unique()
            self.fill(around[~self.is_known.view(-1)[around]])
            return
        needed = torch.zeros_like(self.is_known)
        needed.view(-1).index_fill_(0, lowest, True)
        for axis in range(3):
            length = needed.shape[axis] - 1
            needed.narrow(axis, 1, length).logical_or_(needed.narrow(axis, 0, length).clone())
        self.fill(few_nonzero(needed & ~self.is_known))

    def fill_around(self, grid: MarchGrid, num_rays: int) -> bool:
        """Fill what rays through a grid's occupied cells will want at once, since every round of asking has its price.

        Args:
            grid: with the cells.
            num_rays: that will come. Where matter is not few cells but haze, rays see little of it.

        Returns:
            Whether it was filled: not if that is more than `VERTICES_PER_RAY` vertices for each ray.
        """
        self.move_to(grid.occupancy.device)
        reach = 0.5 * grid.step * (1 - 1 / grid.splits)  # of a part's middle from its interval's, which is in a cell
        around = self.vertices_around(grid.occupancy, grid.aabb, reach)
        if len(around) > VERTICES_PER_RAY * num_rays:
            return False
        self.fill(around)
        return True

    @torch.no_grad()
    def vertices_around(self, occupied: Tensor, aabb: Tensor, reach: float = 0.0) -> Tensor:
        """Vertices, flat places (K,) int64, that are not known, of cells that share space with cells of another grid.

        Args:
            occupied: (Gx, Gy, Gz) bool, which of the other grid's.
            aabb: (2, 3) box that the other grid fills, in world units.
            reach: by which its cells are larger, in every direction, in world units.
        """
        firsts, ends = [], []
        for axis, cell in enumerate(torch.unravel_index(few_nonzero(occupied), occupied.shape)):
            size, cells = occupied.shape[axis], self.levels.cells[axis]
            faces = torch.lerp(aabb[0, axis], aabb[1, axis], torch.linspace(0, 1, size + 1, device=aabb.device))
            lows, highs = (
                (x - self.low[axis]) / self.sides[axis] * cells for x in (faces[:-1] - reach, faces[1:] + reach)
            )
            firsts.append(lows.floor().long()[cell])
            ends.append(highs.ceil().long()[cell] + 1)
        around = covered_places(torch.stack(firsts[::-1]), torch.stack(ends[::-1]), self.is_known.shape)
        return around[~self.is_known.view(-1)[around]]

    def _padded(self, count: int) -> int:
        """A multiple of `pad_to`; below it a power of two, so that a few vertices cost no more than some."""
        if count > self.pad_to:
            return count + -count % self.pad_to
        return min(self.pad_to, max(LEAST_ROWS, 1 << (count - 1).bit_length()))

    @torch.no_grad()
    def fill(self, places: Tensor) -> bool:
        """Ask the deformation at the vertices whose flat places (K,) among (Lz + 1, Ly + 1, Lx + 1) are given.

        Returns:
            Whether there were any.
        """
        if not len(places):
            return False
        for part in places.split(MOST_AT_ONCE):
            self.displacements[part] = self._asked(part)
        self.is_known.view(-1)[places] = True
        return True

    def _asked(self, places: Tensor) -> Tensor:
        """Rows of the table for vertices (K,), K > 0."""
        padded = torch.cat([places, places[-1:].expand(self._padded(len(places)) - len(places))])
        numbers = reversed(torch.unravel_index(padded, self.is_known.shape))
        vertices = torch.stack([faces[number] for faces, number in zip(self.faces, numbers, strict=True)], dim=-1)
        times = vertices.new_full((len(vertices),), self.time)
        canonical = self.deformation(vertices, times)
        rows = torch.nn.functional.pad((canonical - vertices).float(), (0, 1))
        if self.additions is not None:
            rows = torch.cat([rows, self.additions(canonical, times).float()], dim=-1)
        return rows[: len(places)]
