"""Where the pixels of frames of any sizes lie when they are counted through."""

from collections.abc import Sequence

import torch
from torch import Tensor


def evenly_spread(count: int, most: int) -> list[int]:
    """Indices below `count`, at most so many, evenly from the first to the last."""
    return torch.linspace(0, count - 1, min(count, most)).round().long().tolist()


class PixelLayout:
    """Numbers of pixels: frame after frame, each row by row.

    Args:
        sizes: (height, width) of each frame.
        device: of the indices.
    """

    def __init__(self, sizes: Sequence[tuple[int, int]], device: torch.device) -> None:
        self.sizes = tuple(sizes)
        self.shared = self.sizes[0] if len(set(self.sizes)) == 1 else None  # None if sizes differ
        self.starts = [0]  # the first pixel of each frame, and the number of all
        for height, width in self.sizes:
            self.starts.append(self.starts[-1] + height * width)
        if self.shared is None:
            self._starts = torch.tensor(self.starts, device=device)
            self._heights, self._widths = torch.tensor(self.sizes, device=device).unbind(-1)

    @property
    def num_pixels(self) -> int:
        """Number of pixels of all frames together."""
        return self.starts[-1]

    def locate(self, indices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, rows and columns (B,) of pixels (B,) int64 in [0, num_pixels)."""
        if self.shared is not None:
            height, width = self.shared
            rows = indices // width
            frames = rows // height
            return frames, rows - frames * height, indices - rows * width
        frames = torch.searchsorted(self._starts, indices, right=True) - 1
        within = indices - self._starts[frames]
        widths = self._widths[frames]
        rows = within // widths
        return frames, rows, within - rows * widths

    def index(self, frames: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """The inverse of `locate`."""
        if self.shared is not None:
            height, width = self.shared
            return (frames * height + rows) * width + columns
        return self._starts[frames] + rows * self._widths[frames] + columns

    def sides(self, frames: Tensor) -> tuple[int | Tensor, int | Tensor]:
        """Height and width of frames (B,): numbers if all frames share them, else (B,)."""
        return self.shared or (self._heights[frames], self._widths[frames])
