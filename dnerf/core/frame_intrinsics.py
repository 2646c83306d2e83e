"""The intrinsics of many frames, equal ones stored once, and those of rays that belong to them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.lenses import MODELS, project_beyond, undistort

PINHOLE, COEFFICIENTS, RADIUS, MODEL = slice(0, 4), slice(4, 12), 12, 13  # columns of a table


@dataclass(frozen=True, eq=False)
class RayIntrinsics:
    """Intrinsics of R rays, each its own."""

    values: Tensor  # (R, 4) float64 pinholes, or (R, 14) with the lens
    models: tuple[str, ...] = ()  # of the lenses
    iterations: int = 0  # of Newton's method, that undistort all of them

    def pixel_directions(self, columns: Tensor, rows: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Directions in camera space with z = -1: (R,) columns and rows, whole for pixels -> (R, 3)."""
        if not self.models:
            focal_x, focal_y, column, row = self.values.to(dtype).unbind(-1)
            x = (columns.to(dtype) - column) / focal_x
            y = (row - rows.to(dtype)) / focal_y
            return torch.stack([x, y, -torch.ones_like(x)], dim=-1)
        focal_x, focal_y, column, row = self.values[:, PINHOLE].unbind(-1)
        x, y = (columns.double() - column) / focal_x, (rows.double() - row) / focal_y
        coefficients, region = self.values[:, COEFFICIENTS].unbind(-1), (self.values[:, RADIUS], self.iterations)
        x, y = self._chosen([undistort(model, coefficients, x, y, region) for model in self.models])
        return torch.stack([x, -y, -torch.ones_like(x)], dim=-1).to(dtype)

    def seen_at(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Column and row (R,) where positions in the plane at depth 1, x right and y up, are seen."""
        if not self.models:
            focal_x, focal_y, column, row = self.values.to(x.dtype).unbind(-1)
            return x * focal_x + column, row - y * focal_y
        focal_x, focal_y, column, row = self.values[:, PINHOLE].unbind(-1)
        coefficients, radius = self.values[:, COEFFICIENTS].unbind(-1), self.values[:, RADIUS]
        u, v = self._chosen(
            [project_beyond(model, coefficients, radius, x.double(), -y.double()) for model in self.models]
        )
        return (u * focal_x + column).to(x.dtype), (v * focal_y + row).to(x.dtype)

    def _chosen(self, values: Sequence[Sequence[Tensor]]) -> Sequence[Tensor]:
        """The values of each ray's own model."""
        if len(values) == 1:
            return values[0]
        is_first = self.values[:, MODEL] == MODELS.index(self.models[0])
        return [torch.where(is_first, first, second) for first, second in zip(*values)]


class FrameIntrinsics:
    """Intrinsics of F frames.

    Args:
        each: F of them; ValueError for none.
        device: where rays are.
    """

    def __init__(self, each: Sequence[Intrinsics], device: torch.device) -> None:
        if not each:
            raise ValueError("each must hold the intrinsics of at least one frame, got none")
        places: dict[Intrinsics, int] = {}
        indices = [places.setdefault(intrinsics, len(places)) for intrinsics in each]
        stored = tuple(places)
        self.each = tuple(stored[index] for index in indices)
        self.shared = stored[0] if len(stored) == 1 else None  # None if frames differ
        if self.shared is None:
            # A pinhole among lenses is one of OpenCV's, without coefficients; a fisheye's would not be the identity.
            models = {i.distortion.model if i.distortion else "opencv" for i in stored}
            self._models = tuple(name for name in MODELS if name in models) if any(i.distortion for i in stored) else ()
            self._iterations = max((i.region().iterations for i in stored if i.distortion), default=0)
            rows = [_row(intrinsics, self._models) for intrinsics in stored]
            self._table = torch.tensor(rows, dtype=torch.float64, device=device)
            self._indices = torch.tensor(indices, device=device)

    def of(self, frames: Tensor) -> Intrinsics | RayIntrinsics:
        """Intrinsics of rays that belong to frames (R,) int64: one where all frames share it."""
        if self.shared is not None:
            return self.shared
        values = self._table.index_select(0, self._indices.index_select(0, frames))
        return RayIntrinsics(values, self._models, self._iterations)


def _row(intrinsics: Intrinsics, models: tuple[str, ...]) -> list[float]:
    """A row of the table, see the columns above; four numbers if no frame has a lens."""
    if not models:
        return list(intrinsics.pinhole)
    lens = intrinsics.distortion
    if lens is None:
        return [*intrinsics.pinhole, *(0.0,) * 8, math.inf, float(MODELS.index("opencv"))]
    return [*intrinsics.pinhole, *lens.coefficients, intrinsics.region().radius, float(MODELS.index(lens.model))]
