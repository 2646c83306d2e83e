"""Pixels of frames of any sizes: how they are counted through, and the memory that holds them."""

import math
import os
import tempfile
from collections.abc import Sequence

import torch
from torch import Tensor

MAX_MEMORY = 2 * 2**30  # bytes of one split's pixels that are held in memory; more lie in a file mapped into it


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


def empty_images(
    sizes: Sequence[tuple[int, int]], channels: int, max_memory: int = MAX_MEMORY, *, device: str | torch.device = "cpu"
) -> tuple[Tensor, Sequence[Tensor]]:
    """Room for images of sizes (height, width), as in `Frames.images`, and views (H, W, C) of each: `empty_pixels`."""
    if len(set(sizes)) == 1:
        images = empty_pixels((len(sizes), *sizes[0], channels), max_memory, device=device)
        return images, images.unbind()
    areas = [height * width for height, width in sizes]
    images = empty_pixels((sum(areas), channels), max_memory, device=device)
    return images, [part.view(*size, channels) for part, size in zip(images.split(areas), sizes)]


def empty_pixels(shape: Sequence[int], max_memory: int = MAX_MEMORY, *, device: str | torch.device = "cpu") -> Tensor:
    """Contiguous uint8 of a shape, not initialised.

    On the CPU, beyond `max_memory` bytes, it is a temporary file mapped into memory.

    The file lies in the folder for temporary files (`TMPDIR`), which should not be a memory disk. It has no name any
    more when this returns, so it is gone with the tensor, however the process ends.

    Raises:
        ValueError: if the disk has no room for it.
    """
    size = math.prod(shape)
    if size <= max_memory or torch.device(device).type != "cpu":
        return torch.empty(tuple(shape), dtype=torch.uint8, device=device)
    folder = tempfile.gettempdir()
    handle, path = tempfile.mkstemp(prefix="dnerf-pixels-", dir=folder)
    try:
        # Reserved now: a write to a mapped file on a full disk would end the process.
        os.posix_fallocate(handle, 0, size)
        return torch.from_file(path, shared=True, size=size, dtype=torch.uint8).view(tuple(shape))
    except OSError as error:
        raise ValueError(
            f"{folder}: pixels take {size / 2**30:.1f} GiB, for which the disk has no room ({error.strerror}); set "
            "TMPDIR to a folder that has, or lower data.resolution"
        ) from error
    finally:
        os.close(handle)
        os.unlink(path)
