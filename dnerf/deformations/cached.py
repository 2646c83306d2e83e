"""A deformation at fewer places: kept on a lattice for a whole frame, evaluated at knots along rays in training."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_positive
from dnerf.core.geometry import cubes
from dnerf.deformations.base import (
    Deformation,
    PerFrame,
    WrappedDeformation,
    check_one_time,
    check_positions_times,
    deformation_at_time,
)
from dnerf.deformations.knots import between_knots
from dnerf.kernels import GridLevels, MarchGrid, grid_encode

LEAST_ROWS = 256  # fewer take matrix libraries as long
FEW_POINTS = 1024  # whose cells' vertices are listed, not marked in the whole lattice
MOST_AT_ONCE = 1 << 16  # vertices: bounds the memory of networks
VERTICES_PER_RAY = 4  # most to evaluate around all occupied cells, instead of finding out which of them rays need


class CachedDeformation(WrappedDeformation, PerFrame):
    """Another deformation; frames see its displacements through a lattice, training between knots along rays.

    A frame has one time, and displacements vary slowly in space: a lattice of them costs a few thousand evaluations,
    its samples would cost hundreds of thousands. The map is exact at vertices and linear in between, so the error
    falls with the square of the cells' size (`at_time`). In training on a CPU rays interpolate, too (`between_knots`).

    Args:
        deformation: world -> canonical.
        box: (2, 3) corners of the lattice, in world units; outside it the deformation itself is evaluated.
        resolution: cells along the box's longest side; cells are nearly cubes.
        spacing: of knots in training, in world units; twice as much where no gradients are wanted. 0: at every sample.

    Raises:
        ValueError: for a box that is none, a resolution that is not positive or a negative spacing.
    """

    def __init__(
        self, deformation: Deformation, box: Sequence[Sequence[float]], resolution: int = 64, *, spacing: float = 0.0
    ) -> None:
        super().__init__(deformation)
        check_positive("resolution", resolution)
        check_positive("spacing", spacing, allow_zero=True)
        self.spacing = spacing
        corners = as_box(box)
        self.box = nn.Buffer(corners, persistent=False)  # which follows the deformation's precision
        self.cells = cubes(corners, resolution)

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of positions (..., 3) at times (...,); exact for those that want gradients."""
        is_exact = positions.requires_grad or times.requires_grad or positions.is_cuda or self.deformation.is_identity
        if is_exact or not (self.training and self.spacing and positions.ndim == 2 and len(positions)):
            return self.deformation(positions, times)
        check_positions_times(positions, times)
        return between_knots(self.deformation, positions, times, self.spacing * (1 if torch.is_grad_enabled() else 2))

    def at_time(self, time: float, extent: Tensor | None = None) -> Deformation:
        """The lattice at a time, for what lies in a box (2, 3); the deformation itself, if nothing moves."""
        inner = deformation_at_time(self.deformation, time, extent)
        if inner.is_identity:
            return inner
        return CachedAtTime(inner, self._faces(extent), time)

    def _faces(self, extent: Tensor | None) -> list[Tensor]:
        """Where vertices are on each axis, at least two; only those of cells that reach into a box (2, 3), if given."""
        faces, box = [], self.box.cpu()
        for axis, cells in enumerate(self.cells):
            low, side = box[0, axis], box[1, axis] - box[0, axis]
            first, end = 0, cells
            if extent is not None:
                places = ((extent[:, axis].cpu() - low) / side * cells).clamp(0, cells)
                first = min(int(places[0]), cells - 1)
                end = max(math.ceil(places[1]), first + 1)
            faces.append(low + side * torch.arange(first, end + 1, dtype=box.dtype) / cells)
        return faces


class CachedAtTime(Deformation):
    """A deformation at one time, seen through a lattice that is filled where positions fall.

    For rendering: what was computed once is kept, so it knows nothing of later changes of the deformation, and no
    gradient reaches the deformation.

    Args:
        deformation: what is evaluated at vertices, and outside the lattice.
        faces: where vertices are on each axis, at least two, in world units.
        time: in [0, 1]; the only one at which it may be called.
        pad_to: the number of vertices evaluated is rounded up to a multiple of this, or to a power of two below it,
            since matrix libraries compile code for every new number of rows.
    """

    def __init__(self, deformation: Deformation, faces: Sequence[Tensor], time: float, *, pad_to: int = 2048) -> None:
        super().__init__()
        self.deformation = deformation
        self.time = time
        self.pad_to = pad_to
        self.faces = list(faces)
        num_vertices = math.prod(len(x) for x in self.faces)
        self.levels = GridLevels.dense([[len(x) - 1 for x in self.faces]])
        self.low = torch.stack([x[0] for x in self.faces])
        self.sides = torch.stack([x[-1] for x in self.faces]) - self.low
        self.displacements = torch.full((num_vertices, 4), torch.nan)  # four, so that rows are aligned
        self.is_known = torch.zeros([len(x) for x in reversed(self.faces)], dtype=torch.bool)

    @torch.no_grad()
    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Canonical positions (..., 3) of positions (..., 3) at times (...,); ValueError for times not its own."""
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

    def move_to(self, device: torch.device) -> None:
        """Have what is kept on a device."""
        if self.displacements.device != device:
            self.low, self.sides = self.low.to(device), self.sides.to(device)
            self.faces = [x.to(device) for x in self.faces]
            self.displacements, self.is_known = self.displacements.to(device), self.is_known.to(device)

    def _fill(self, unit: Tensor) -> None:
        """Evaluate the deformation at the vertices of the points' cells that are not known yet."""
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
        self.fill((needed & ~self.is_known).view(-1).nonzero()[:, 0])

    def fill_around(self, grid: MarchGrid, num_rays: int) -> bool:
        """Fill what rays through a grid's occupied cells will need at once: every round of evaluations has its price.

        Returns whether it was: not if that is more than `VERTICES_PER_RAY` vertices for each of the rays that will
        come. Where nearly all cells are occupied, rays see little of them.
        """
        self.move_to(grid.occupancy.device)
        # Of a part's middle from its interval's, which is in a cell.
        reach = 0.5 * grid.step * (1 - 1 / grid.subdivision)
        around = self.vertices_around(grid.occupancy, grid.aabb, reach)
        if len(around) > VERTICES_PER_RAY * num_rays:
            return False
        self.fill(around)
        return True

    @torch.no_grad()
    def vertices_around(self, occupied: Tensor, aabb: Tensor, reach: float = 0.0) -> Tensor:
        """Vertices, flat places (K,) int64, that are not known, of cells that share space with cells of another grid.

        Those are the occupied ones, (Gx, Gy, Gz) bool, of a grid that fills a box (2, 3), larger by `reach` (in world
        units) in every direction.
        """
        covered = occupied.float()
        for axis, vertices in enumerate(self.faces):
            size, cells = occupied.shape[axis], self.levels.cells[axis]
            faces = torch.lerp(aabb[0, axis], aabb[1, axis], torch.linspace(0, 1, size + 1, device=aabb.device))
            lows, highs = (
                (x - self.low[axis]) / self.sides[axis] * cells for x in (faces[:-1] - reach, faces[1:] + reach)
            )
            number = torch.arange(len(vertices), device=aabb.device)
            is_reached = (number >= lows.floor()[:, None]) & (number <= highs.ceil()[:, None])
            # A cell reaches a box of vertices: how many cells reach each is a product along one axis after the other.
            with torch.autocast(covered.device.type, enabled=False):
                covered = torch.tensordot(covered, is_reached.float(), ([0], [0]))
        around = (covered > 0).permute(2, 1, 0).flatten().nonzero()[:, 0]
        return around[~self.is_known.view(-1)[around]]

    def _padded(self, count: int) -> int:
        """A multiple of `pad_to`; below it a power of two, so that a few vertices cost no more than some."""
        if count > self.pad_to:
            return count + -count % self.pad_to
        return min(self.pad_to, max(LEAST_ROWS, 1 << (count - 1).bit_length()))

    @torch.no_grad()
    def fill(self, places: Tensor) -> None:
        """Evaluate the deformation at the vertices whose flat places (K,) among (Lz + 1, Ly + 1, Lx + 1) are given."""
        if not len(places):
            return
        for part in places.split(MOST_AT_ONCE):
            self.displacements[part] = self._evaluated(part)
        self.is_known.view(-1)[places] = True

    def _evaluated(self, places: Tensor) -> Tensor:
        """Rows of the table for vertices (K,), K > 0."""
        padded = torch.cat([places, places[-1:].expand(self._padded(len(places)) - len(places))])
        numbers = reversed(torch.unravel_index(padded, self.is_known.shape))
        vertices = torch.stack([faces[number] for faces, number in zip(self.faces, numbers, strict=True)], dim=-1)
        times = vertices.new_full((len(vertices),), self.time)
        canonical = self.deformation(vertices, times)
        return torch.nn.functional.pad((canonical - vertices).float(), (0, 1))[: len(places)]
