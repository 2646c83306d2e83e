"""Multi-resolution grid encoding: trilinear lookups in dense and hashed feature grids."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from .backend import choose
from .checks import check_shapes
from .op import op

HASH_PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class GridLevels:
    """The resolutions of a multi-resolution grid, and where each level's rows lie in the shared table.

    A level with (Rx, Ry, Rz) cells has (Rx + 1)(Ry + 1)(Rz + 1) vertices. It is dense if they fit into `max_rows`
    rows, x varying fastest; otherwise vertex (x, y, z) takes row
    `(x ^ y * 2654435761 ^ z * 805459861) mod max_rows` (Mueller et al. 2022, "Instant neural graphics primitives",
    eq. 4), and collisions are left to training. A dense level without cells along z is a plane: z counts for nothing.

    Args:
        resolutions: per level the number of cells per axis, one int or three, of which the last may be 0.
        max_rows: most rows of one level, a power of two.

    Raises:
        ValueError: no level, a resolution that is not positive, or `max_rows` not a power of two below 2^31.
    """

    resolutions: Sequence[int | Sequence[int]]
    max_rows: int

    def __post_init__(self) -> None:
        triples = tuple((r, r, r) if isinstance(r, int) else tuple(int(c) for c in r) for r in self.resolutions)
        if not triples or any(len(r) != 3 or min(r[0], r[1], r[2] + 1) < 1 for r in triples):
            raise ValueError(f"resolutions must be positive ints or triples of them, got {self.resolutions}")
        if not 0 < self.max_rows < 2**31 or self.max_rows & (self.max_rows - 1):
            raise ValueError(f"max_rows must be a power of two below 2^31, got {self.max_rows}")
        object.__setattr__(self, "resolutions", triples)

    @classmethod
    def dense(cls, resolutions: Sequence[Sequence[int]]) -> "GridLevels":
        """Levels of which every vertex has a row of its own."""
        return cls(resolutions, 1 << (max(cls(resolutions, 1).vertices) - 1).bit_length())

    @cached_property
    def cells(self) -> list[int]:
        """Cells per axis of every level, flattened: 3 L ints."""
        return [int(c) for r in self.resolutions for c in r]  # type: ignore[union-attr]

    @cached_property
    def vertices(self) -> tuple[int, ...]:
        """Number of vertices of every level."""
        c = self.cells
        return tuple((c[i] + 1) * (c[i + 1] + 1) * (c[i + 2] + 1) for i in range(0, len(c), 3))

    @cached_property
    def hashed(self) -> tuple[bool, ...]:
        """Whether a level's vertices share rows."""
        return tuple(v > self.max_rows for v in self.vertices)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First row of every level in the table, and the total at the end: L + 1 ints."""
        return tuple(accumulate((min(v, self.max_rows) for v in self.vertices), initial=0))

    @property
    def num_levels(self) -> int:
        return len(self.resolutions)

    @property
    def num_rows(self) -> int:
        """Rows of the whole table."""
        return self.offsets[-1]

    def describe(self) -> list[list[int]]:
        """Per level: cells along x, y, z, first row, and the hash mask (rows - 1), or -1 for a dense level."""
        return [
            [*self.cells[3 * i : 3 * i + 3], self.offsets[i], self.max_rows - 1 if self.hashed[i] else -1]
            for i in range(self.num_levels)
        ]


def grid_encode(positions: Tensor, table: Tensor, levels: GridLevels, *, rounded: bool = False) -> Tensor:
    """Interpolate the features of every grid level at the given positions.

    Per level, `sum_c w_c table[row(c)]` over the 8 vertices of the position's cell, with trilinear weights w.
    Positions are clamped to the unit cube and have a zero gradient along the axes where they are outside. On a
    cell face the gradient to the position is that of the cell above it.

    Args:
        positions: (N, 3), in [0, 1], differentiable.
        table: (T, F), differentiable; T = `levels.num_rows`.
        levels: the grid's resolutions and table layout.
        rounded: to bfloat16, for networks that would round them anyway; where gradients are recorded, and in float64,
            this is ignored.

    Returns:
        (N, L F) features, level by level, in the wider dtype of the arguments and at least float32 if not rounded.

    Raises:
        ValueError: a shape that does not fit.

    The compiled versions are differentiable once; second derivatives need `use_backend("reference")`. The gradient
    to the table is deterministic on the CPU; on a GPU it uses atomic adds.
    """
    check_grid(positions, table, levels)
    if positions.dtype != table.dtype or positions.dtype != torch.float32:
        dtype = torch.promote_types(torch.promote_types(positions.dtype, table.dtype), torch.float32)
        positions, table = positions.to(dtype), table.to(dtype)
    rounded = rounded and positions.dtype == torch.float32 and not torch.is_grad_enabled()
    if choose(positions) != "reference":
        return _grid_encode(positions, table, levels.cells, levels.max_rows, rounded)
    features = grid_encode_reference(positions, table, levels)
    return features.bfloat16() if rounded else features


def check_grid(positions: Tensor, table: Tensor, levels: GridLevels) -> None:
    """Raise ValueError unless shapes are those that `grid_encode` asks for."""
    check_shapes(positions=(positions, ("N", 3)), table=(table, (levels.num_rows, "F")))


def grid_encode_reference(positions: Tensor, table: Tensor, levels: GridLevels) -> Tensor:
    """The definition of `grid_encode` in plain torch; any device and float dtype, differentiable to any order."""
    corners = torch.tensor([(k & 1, k >> 1 & 1, k >> 2) for k in range(8)], dtype=torch.int64, device=positions.device)
    clamped = positions.clamp(0, 1)
    features = []
    for rx, ry, rz, offset, mask in levels.describe():
        cells = torch.tensor((rx, ry, rz), device=positions.device)
        scaled = clamped * cells.to(positions.dtype)
        lower = scaled.detach().floor().long().clamp(min=torch.zeros_like(cells), max=(cells - 1).clamp(min=0))
        fraction = (scaled - lower.to(scaled.dtype))[:, None]
        weights = torch.where(corners.bool(), fraction, 1 - fraction).prod(-1)
        x, y, z = torch.minimum(lower[:, None] + corners, cells).unbind(-1)
        if mask >= 0:
            rows = (x * HASH_PRIMES[0] ^ y * HASH_PRIMES[1] ^ z * HASH_PRIMES[2]) & mask
        else:
            rows = x + (rx + 1) * (y + (ry + 1) * z)
        features.append((weights[..., None] * table[offset + rows]).sum(1))
    return torch.cat(features, -1)


_INPUTS = "Tensor positions, Tensor table, int[] cells, int max_rows"
_grad_table, _grad_positions = (
    op(f"grid_encode_grad_{to}(Tensor grad, {_INPUTS}) -> Tensor", f"grid_encode.grad_{to}", gradient_of="grid_encode")
    for to in ("table", "positions")
)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    positions, table, ctx.cells, ctx.max_rows, _ = inputs
    ctx.save_for_backward(positions, table)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    arguments = (grad, *ctx.saved_tensors, ctx.cells, ctx.max_rows)
    needs_positions, needs_table = ctx.needs_input_grad[:2]
    to_positions = _grad_positions(*arguments) if needs_positions else None
    return to_positions, _grad_table(*arguments) if needs_table else None, None, None, None


_grid_encode = op(
    f"grid_encode({_INPUTS}, bool rounded) -> Tensor", "grid_encode.forward", backward=_backward, setup_context=_save
)
