"""A finished canonical field on a lattice of bricks: what frames of a sequence share is computed once."""

import logging
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.checks import as_box, check_positive
from dnerf.compositing import FieldOutput
from dnerf.deformations.base import check_positions_times
from dnerf.fields.base import RadianceField
from dnerf.kernels import brick_lookup
from dnerf.kernels.brick_lookup import BRICK, VERTICES

logger = logging.getLogger(__name__)

CHUNK = 32  # bricks asked at a time, always as many: matrix libraries compile code for every new number of rows


class Baking:
    """The geometry of lattices that stand in for a finished canonical field.

    Every frame of a sequence looks at the same canonical matter. The field's contents at the vertices of a fine
    lattice, interpolated linearly, cost one lookup; a multi-resolution grid costs one per level, and a network.
    Vertices are computed when a sample first falls near them, brick by brick, so that only what is looked at exists.
    The field is exact at vertices, as far as half precision goes, and the error falls with the square of the cells'
    size where it is smooth.

    Args:
        box: (2, 3) corners of the space that the lattice covers, in world units; outside its bricks, which are whole,
            the field itself is asked.
        resolution: cells along the box's longest side.
        max_bricks: most bricks of 8 x 8 x 8 cells that are kept, of 1.4 KiB for each number of a field's contents (23
            KiB each and 182 MiB in all for 16); where there is no room for more, the field itself is asked.

    Raises:
        ValueError: for a box that is none, or numbers that are not positive.
    """

    def __init__(self, box: Sequence[Sequence[float]], resolution: int = 384, *, max_bricks: int = 1 << 13) -> None:
        check_positive("resolution", resolution)
        check_positive("max_bricks", max_bricks)
        self.box = as_box(box)
        sides = self.box[1] - self.box[0]
        self.cells_per_unit = resolution / float(sides.max())
        # Rounded, so that rounding of the sides adds no bricks.
        self.shape = [max(1, math.ceil(round(float(s) * self.cells_per_unit / BRICK, 3))) for s in sides]
        self.max_bricks = max_bricks

    def bake(self, field: RadianceField) -> "BakedField":
        """A stand-in for a field that nothing changes any more.

        Raises:
            ValueError: if the field has no contents that could be kept.
        """
        return BakedField(field, self)


class BakedField(RadianceField):
    """A field seen through a lattice that is filled where positions fall; see `Baking`.

    For rendering: it knows nothing of later changes of the field, and no gradient reaches it. Of a field that has more
    to say than its contents (`has_changes`), whoever reads the bricks adds the `changes`; if it is asked as fields are,
    the field itself answers.

    Args:
        field: whose contents are kept.
        baking: the vertices.

    Raises:
        ValueError: if the field has no contents that could be kept.
    """

    def __init__(self, field: RadianceField, baking: Baking) -> None:
        super().__init__()
        if not field.num_contents:
            raise ValueError(f"field must have contents to keep, got a {type(field).__name__} without")
        self.field = field
        self.low = baking.box[0]
        self.cells_per_unit = baking.cells_per_unit
        self.max_bricks = baking.max_bricks
        self.num_bricks = 0
        self.is_full = False
        self.slots = torch.full(baking.shape, -1)  # per brick of the box: its number, -1 if it does not exist
        self.bricks = torch.zeros(0, VERTICES, field.num_contents, dtype=torch.float16)  # at its vertices

    @property
    def num_contents(self) -> int:
        """As of the field it stands for."""
        return self.field.num_contents

    @property
    def has_changes(self) -> bool:
        """As of the field it stands for."""
        return self.field.has_changes

    def from_contents(self, contents: Tensor, times: Tensor) -> FieldOutput:
        """As the field it stands for."""
        return self.field.from_contents(contents, times)

    def changes(self, positions: Tensor, times: Tensor) -> Tensor:
        """As the field it stands for."""
        return self.field.changes(positions, times)

    def series_at(self, time: float) -> tuple[Tensor, float] | None:
        """As of the field it stands for."""
        return self.field.series_at(time)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        """Density (...,) at positions (..., 3) and times (...,)."""
        return self(positions, positions, times).density

    @torch.no_grad()
    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        """Density (...,) and rgb (..., 3) at positions (..., 3), for all directions (..., 3) and at times (...,)."""
        check_positions_times(positions, times)
        if self.has_changes:
            return self.field(positions, directions, times)
        times = times.reshape(-1)[0] if times.numel() and bool((times == times.reshape(-1)[0]).all()) else times
        return self.from_contents(self.contents(positions), times)

    @torch.no_grad()
    def contents(self, positions: Tensor) -> Tensor:
        """Interpolated contents (..., C) at positions (..., 3), in their dtype."""
        self.move_to(positions.device)
        points = positions.reshape(-1, 3)
        cells = ((points - self.low.to(points.dtype)) * self.cells_per_unit).float()
        values, is_known = self._values(cells)
        values = values.to(points.dtype)
        if not bool(is_known.all()):
            rest = (~is_known).nonzero()[:, 0]
            values[rest] = self.field.contents(points[rest]).to(points.dtype)
        return values.reshape(*positions.shape[:-1], values.shape[-1])

    def _values(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Values (N, C) at places (N, 3) in cells, and where they are known (N,): in the box, while there is room."""
        found = brick_lookup(cells, self.slots, self.bricks)
        if self.is_full:
            return found
        missing = self._missing(cells[~found[1]])
        return brick_lookup(cells, self.slots, self.bricks) if self.make(missing) else found

    def move_to(self, device: torch.device) -> None:
        """Have what is kept on a device."""
        if self.slots.device != device:
            self.low, self.slots, self.bricks = (x.to(device) for x in (self.low, self.slots, self.bricks))

    def _missing(self, cells: Tensor) -> Tensor:
        """Which bricks (K, 3) around places in cells (n, 3) do not exist."""
        shape = torch.tensor(self.slots.shape, device=cells.device)
        cells = cells[((cells >= 0) & (cells <= shape * BRICK)).all(-1)]
        is_wanted = torch.zeros_like(self.slots, dtype=torch.bool)
        is_wanted[torch.minimum(cells.long() // BRICK, shape - 1).unbind(-1)] = True
        return (is_wanted & (self.slots < 0)).nonzero()

    @torch.no_grad()
    def make(self, missing: Tensor) -> bool:
        """Make the bricks at places (K, 3) among those of the box, all or, if there is no room, none.

        Returns:
            Whether any were made.
        """
        if not len(missing) or self.is_full:
            return False
        if self.num_bricks + len(missing) > self.max_bricks:
            logger.warning("baking: no room for more than %d bricks, the field is asked itself", self.max_bricks)
            self.is_full = True
            return False
        side = torch.arange(BRICK + 1, device=missing.device)
        vertices = torch.cartesian_prod(side, side, side)
        end = self.num_bricks + len(missing)
        self._make_room(end)
        numbers = torch.arange(self.num_bricks, end, device=missing.device)
        most = torch.finfo(self.bricks.dtype).max
        for part, number in zip((missing * BRICK).split(CHUNK), numbers.split(CHUNK), strict=True):
            asked = torch.cat([part, part[-1:].expand(CHUNK - len(part), 3)])
            points = self.low + (asked[:, None] + vertices).reshape(-1, 3) / self.cells_per_unit
            values = self.field.contents(points).clamp(-most, most).reshape(CHUNK, VERTICES, -1)
            self.bricks[number] = values[: len(part)].to(self.bricks.dtype)
        self.slots[missing.unbind(-1)] = numbers
        self.num_bricks = end
        return True

    def _make_room(self, count: int) -> None:
        """Room for so many bricks; if there was less, for twice as many as before at least."""
        held = len(self.bricks)
        if count > held:
            room = min(max(count, 2 * held), self.max_bricks)
            bricks = self.bricks.new_empty(room, *self.bricks.shape[1:])
            bricks[:held] = self.bricks
            self.bricks = bricks
