"""Memory for pixels: what is larger than a bound lies in a file that is mapped into memory."""

import math
import os
import tempfile
from collections.abc import Sequence

import torch
from torch import Tensor

MAX_MEMORY = 2 * 2**30  # bytes of one split's pixels that are held in memory


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
