"""Which pixels the cells of a grid cover on an image, and how deep they lie behind each."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dnerf.core.geometry import cube_corners
from dnerf.core.rays import parts_of

from .backend import choose, run_compiled
from .checks import check_cells, check_shapes


class Footprints(NamedTuple):
    """P pixels of an image that cells cover.

    Attributes:
        pixels: (P,) int64, `row * width + column`, in order, each once.
        depths: (2, P) least and greatest z-depth of the cells whose rectangles hold the pixel, in world units.
    """

    pixels: Tensor
    depths: Tensor


@torch.no_grad()
def footprints(
    occupancy: Tensor, aabb: Tensor, pose: Tensor, lens: Sequence[float], size: tuple[int, int]
) -> Footprints | None:
    """Pixels inside the rectangles that span cells on an image.

    Cells are convex, so the rectangle around a cell's corners holds all of it, and the corners' depths bound its own.

    Args:
        occupancy: (Gx, Gy, Gz) bool, which cells.
        aabb: (2, 3) box that the cells fill, in world units.
        pose: (4, 4) camera-to-world, OpenGL axes.
        lens: focal lengths along x and y, column and row of the principal point, in pixels; rays of pixels go through
            whole numbers.
        size: height and width of the image in pixels.

    Returns:
        The pixels, or None if a cell does not lie before the camera.

    Raises:
        ValueError: shapes or types that do not fit.
    """
    check_cells("occupancy", occupancy, "Gx, Gy, Gz")
    check_shapes(aabb=(aabb, (2, 3)), pose=(pose, (4, 4)))
    if len(lens) != 4 or len(size) != 2 or min(size) < 0:
        raise ValueError(f"lens must be four numbers and size two, not negative, got {tuple(lens)} and {tuple(size)}")
    places = occupancy.reshape(-1).nonzero()[:, 0]
    low, high = aabb.to(pose.dtype)
    faces = [
        torch.lerp(low[axis], high[axis], torch.linspace(0, 1, cells + 1, dtype=pose.dtype, device=pose.device))
        for axis, cells in enumerate(occupancy.shape)
    ]
    if pose.is_cpu and choose(pose) == "numba":
        return run_compiled("footprints", "footprints", pose, places, faces, lens, size)
    return footprints_reference(pose, places, faces, lens, size)


def footprints_reference(
    pose: Tensor, places: Tensor, faces: Sequence[Tensor], lens: Sequence[float], size: tuple[int, int]
) -> Footprints | None:
    """The definition of `footprints` in plain torch, of cells at flat places (K,) among those between faces."""
    cells = torch.unravel_index(places, [len(x) - 1 for x in faces])
    offsets = [
        face[cell[:, None] + corner] - pose[axis, 3]
        for axis, (face, cell, corner) in enumerate(zip(faces, cells, cube_corners(pose.device).T, strict=True))
    ]
    x, y, z = (
        offsets[0] * pose[0, axis] + offsets[1] * pose[1, axis] + offsets[2] * pose[2, axis] for axis in range(3)
    )
    depth = -z
    scale = 1 / depth
    columns, rows = x * scale * lens[0] + lens[2], lens[3] - y * scale * lens[1]
    if not bool((depth > 0).all() & columns.isfinite().all() & rows.isfinite().all()):
        return None
    height, width = size
    # Cut off while they are floats: what lies far beyond the image may have no number.
    left, top = (p.amin(-1).floor().clamp(0, most).long() for p, most in ((columns, width), (rows, height)))
    right, bottom = (
        (p.amax(-1).ceil().clamp(min=-1) + 1).clamp(max=most).long() for p, most in ((columns, width), (rows, height))
    )
    wide = (right - left).clamp(min=0)
    counts = wide * (bottom - top).clamp(min=0)
    owner, within = parts_of(counts)
    pixels = (top[owner] + within // wide[owner]) * width + left[owner] + within % wide[owner]
    depths = [
        depth.new_full((height * width,), unseen).scatter_reduce_(0, pixels, extreme[owner], reduction)
        for unseen, extreme, reduction in ((torch.inf, depth.amin(-1), "amin"), (-torch.inf, depth.amax(-1), "amax"))
    ]
    seen = depths[0].isfinite().nonzero()[:, 0]
    return Footprints(seen, torch.stack(depths)[:, seen])
