"""Space carving: what images with alpha, or before one colour, can show lies where views near in time are opaque.

The scene moves and most data sets have one view of each time, so views of other times carve, too. On the ray of an
opaque pixel, each position has its *support*: how many consecutive views, its own among them, have it in an opaque
pixel. What a view shows lies where the support along the ray is large (image-based visual hull, Matusik et al. 2000,
with views near in time in place of views of one time). Where motion is too fast for any position to have support, the
whole ray counts, so that a box becomes too large rather than too small.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from dnerf.core.cameras import camera_rays
from dnerf.core.frame_intrinsics import FrameIntrinsics
from dnerf.core.geometry import ray_box
from dnerf.core.rays import Rays
from dnerf.data.frames import Frames

# Alpha, or difference from the colour behind, of 255, from which a pixel shows something: a tenth, so that the rims of
# fog count.
OPAQUE = 26
NUM_BLOCKS = 100  # of pixels along an image's longer side, each opaque if one of its pixels is
MAX_RAYS = 12_000  # of outlines, evenly spread over all views: half a second on one core
NUM_DISTANCES = 48  # along each
MAX_SUPPORT = 16  # views: random ones from a hemisphere meet in little more than the body
SHARE_OF_SUPPORT = 0.75  # of the largest along a ray, which a position needs
# Of an image's longer side, from one time to the next: the first with enough support.
MOTIONS = (0.001, 0.005, 0.02, 0.08)
ENOUGH = 8  # views
MAX_DISTANCE = 32  # blocks, up to which motion is allowed for
EVERY_PIXEL = 3  # in rows and columns, of those that are looked at one by one


@dataclass(frozen=True)
class Silhouettes:
    """Opaque blocks of pixels of all views in order of time."""

    intrinsics: FrameIntrinsics
    planes: tuple[float, float]  # z-depths where rays begin and end
    poses: Tensor  # (F, 4, 4) camera-to-world
    times: Tensor  # (F,) times as whole numbers: how many different ones come before
    block: int  # pixels along a block's sides
    # (F, H, W) uint8, how many blocks away the nearest opaque one is, by rows or columns, whichever is more; 255 beyond
    # `MAX_DISTANCE`. Smaller views lie in the upper left corner.
    distances: Tensor

    @classmethod
    def of(
        cls, frames: Frames, behind: Tensor | None = None, *, least: int = OPAQUE, unknown: float = 0.0
    ) -> "Silhouettes":
        """Of frames with alpha, or before a colour (3,) in [0, 1], with at least so much of 255, see `shown`."""
        block = -(-max(max(size) for size in frames.layout.sizes) // NUM_BLOCKS)
        order = frames.times.argsort(stable=True)
        rows = order.tolist()
        blocks = [max_pool2d(shown(frames, i, behind, unknown)[None], block, ceil_mode=True) for i in rows]
        sizes = [each.shape[1:] for each in blocks]
        height, width = (max(size[axis] for size in sizes) for axis in (0, 1))
        blocks = [pad(each, (0, width - each.shape[2], 0, height - each.shape[1])) for each in blocks]
        opaque = torch.cat(blocks) >= least
        distances = torch.where(opaque, 0, 255).to(torch.uint8)
        for distance in range(1, MAX_DISTANCE + 1):
            opaque = _dilated(opaque)
            distances.masked_fill_(opaque & (distances == 255), distance)
        for view, (rows_in, columns_in) in zip(distances, sizes):
            view[rows_in:], view[:, columns_in:] = 255, 255
        times = frames.times[order].unique(return_inverse=True)[1]
        intrinsics = FrameIntrinsics([frames.intrinsics[i] for i in rows], order.device)
        return cls(intrinsics, (frames.near, frames.far), frames.poses[order], times, block, distances)

    def outlines(self) -> tuple[Tensor, Rays]:
        """Views (R,) and rays of opaque blocks beside clear ones or at the border: what is opaque ends on such rays."""
        # The border is clear, and so is what lies beyond a smaller view.
        clear = _dilated(pad(self.distances > 0, (1, 1, 1, 1), value=True))[:, 1:-1, 1:-1]
        views, rows, columns = ((self.distances == 0) & clear).nonzero().unbind(-1)
        kept = slice(None, None, max(1, -(-len(views) // MAX_RAYS)))
        views, rows, columns = views[kept], rows[kept], columns[kept]
        near, far = self.planes
        columns, rows = ((index + 0.5) * self.block - 0.5 for index in (columns, rows))
        times = torch.zeros(len(views), device=views.device)
        lenses = self.intrinsics.of(views)
        return views, camera_rays(lenses, self.poses[views], columns, rows, times=times, near=near, far=far)

    def support(self, views: Tensor, rays: Rays, distances: Tensor, motion: float) -> Tensor:
        """How many consecutive views have positions on rays in opaque pixels, the rays' own among them: (R, D) int64.

        Args:
            views: (R,) indices of the rays' own.
            rays: R rays.
            distances: (R, D) along them.
            motion: share of an image's longer side by which bodies may move from one time to the next.
        """
        flat = distances.reshape(-1)
        support = torch.ones_like(flat, dtype=torch.int64)
        for side in (-1, 1):
            alive = torch.arange(len(flat), device=flat.device)
            for offset in range(1, MAX_SUPPORT):
                others = views + side * offset
                alive = alive[((others >= 0) & (others < len(self.poses)))[alive // distances.shape[1]]]
                if not len(alive):
                    break
                others = others.clamp(0, len(self.poses) - 1)
                moved = motion * max(self.distances.shape[1:]) * (self.times[others] - self.times[views]).abs()
                reach = (1 + moved).clamp(max=MAX_DISTANCE)
                alive = alive[self._are_opaque(others, rays, alive // distances.shape[1], flat[alive], reach)]
                support[alive] += 1
        return support.clamp(max=MAX_SUPPORT).view_as(distances)

    def share_of_views(self, rays: Rays, distances: Tensor, reach: int) -> Tensor:
        """The share (R, D) of all views that have positions at distances (R, D) within so many blocks of an opaque
        pixel."""
        flat = distances.reshape(-1)
        index = torch.arange(len(rays), device=flat.device).repeat_interleave(distances.shape[1])
        share = torch.zeros_like(flat)
        for view in range(len(self.poses)):
            others = torch.full((len(rays),), view, device=flat.device)
            share += self._are_opaque(others, rays, index, flat, torch.full_like(others, reach))
        return (share / len(self.poses)).view_as(distances)

    def _are_opaque(self, others: Tensor, rays: Rays, index: Tensor, distances: Tensor, reach: Tensor) -> Tensor:
        """Whether positions (N,) on rays `index` are within `reach` (R,) blocks of opaque ones of other views (R,)."""
        rotation, position = self.poses[others, :3, :3], self.poses[others, :3, 3]
        # Rays in the other camera's axes, once for all of their positions.
        start = (rotation * (rays.origins - position)[:, :, None]).sum(1)
        along = (rotation * rays.directions[:, :, None]).sum(1)
        x, y, z = (start[index] + distances[:, None] * along[index]).unbind(-1)
        lenses = self.intrinsics.shared or self.intrinsics.of(others[index])
        columns, rows = (((place + 0.5) / self.block).floor() for place in lenses.seen_at(x / -z, y / -z))
        height, width = self.distances.shape[1:]
        near, far = self.planes
        is_seen = (-z >= near) & (-z <= far) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        kept = is_seen.nonzero()[:, 0]
        index = index[kept]
        away = self.distances[others[index], rows[kept].long(), columns[kept].long()]
        is_seen[kept] = away <= reach[index]
        return is_seen


def carve(silhouettes: Silhouettes, box: Tensor) -> Tensor | None:
    """Corners (2, 3) of the part of a box (2, 3) that holds what opaque pixels can show, in world units.

    None if a ray of an outline misses the box, or there are no outlines.
    """
    views, rays = silhouettes.outlines()
    enter, leave = ray_box(rays.origins, rays.directions, box)
    enter, leave = enter.maximum(rays.near).maximum(1e-3 * rays.far), leave.minimum(rays.far)
    if not len(views) or bool((enter >= leave).any()):
        return None
    # Evenly spread over the logarithm, as steps in the image are.
    steps = (torch.arange(NUM_DISTANCES, device=box.device) + 0.5) / NUM_DISTANCES
    distances = enter[:, None] * (leave / enter)[:, None] ** steps
    support = silhouettes.support(views, rays, distances, MOTIONS[0])
    for motion in MOTIONS[1:]:
        weak = (support.amax(1) < ENOUGH).nonzero()[:, 0]
        support[weak] = silhouettes.support(views[weak], rays[weak], distances[weak], motion)
    index, step = (support >= SHARE_OF_SUPPORT * support.amax(1, keepdim=True)).nonzero().unbind(-1)
    chosen = distances[index, step]
    positions = rays.origins[index] + chosen[:, None] * rays.directions[index]
    spacing = (leave / enter).log()[index] / NUM_DISTANCES
    blocks = torch.tensor([silhouettes.block / lens.focal_x for lens in silhouettes.intrinsics.each], device=box.device)
    room = 0.5 * chosen * spacing.maximum(blocks[views[index]])
    return torch.stack([(positions - room[:, None]).amin(0), (positions + room[:, None]).amax(0)])


def hold_opaque(frames: Frames, box: Tensor, behind: Tensor | None = None) -> Tensor:
    """A box (2, 3), grown until no opaque pixel looks past it: to the position on its ray that is nearest to the box.

    One of `EVERY_PIXEL` squared pixels of each view is looked at.
    """
    steps = torch.linspace(0, 1, NUM_DISTANCES, device=box.device)
    for index in range(len(frames)):
        rays = opaque_rays(frames, index, behind)
        enter, leave = ray_box(rays.origins, rays.directions, box)
        past = rays[((enter > leave) | (leave < rays.near) | (enter > rays.far)).nonzero()[:, 0]]
        distances = past.near[:, None] + (past.far - past.near)[:, None] * steps
        positions = past.origins[:, None] + distances[..., None] * past.directions[:, None]
        outside = (positions - positions.clamp(box[0], box[1])).norm(dim=-1)
        nearest = positions[torch.arange(len(past), device=box.device), outside.argmin(-1)]
        box = torch.stack([torch.cat([box[:1], nearest]).amin(0), torch.cat([box[1:], nearest]).amax(0)])
    return box


def opaque_rays(frames: Frames, index: int, behind: Tensor | None = None) -> Rays:
    """The rays of one in `EVERY_PIXEL` squared opaque pixels of a frame."""
    levels = shown(frames, index, behind)
    rows, columns = (levels[::EVERY_PIXEL, ::EVERY_PIXEL] >= OPAQUE).nonzero().unbind(-1)
    return frames.camera(index).rays(0.0, EVERY_PIXEL * (rows * levels.shape[1] + columns))


def shown(frames: Frames, index: int, behind: Tensor | None, unknown: float = 0.0) -> Tensor:
    """How much of something each pixel shows, (H, W) float32 in [0, 255]: its alpha, or with a colour (3,) in [0, 1]
    behind opaque images, the largest difference from it. What has that colour itself needs no density. `unknown` is for
    pixels that do not count."""
    image, known = frames.stored_image(index).float(), frames.known(index)
    levels = image[..., 3] if behind is None else (image[..., :3] - 255 * behind.to(image)).abs().amax(-1)
    return levels if known is None else torch.where(known, levels, unknown)


def _dilated(blocks: Tensor) -> Tensor:
    """Blocks (F, H, W) bool and those beside and diagonal to them."""
    for axis in (1, 2):
        size = blocks.shape[axis]
        wider = blocks.clone()
        wider.narrow(axis, 1, size - 1).logical_or_(blocks.narrow(axis, 0, size - 1))
        wider.narrow(axis, 0, size - 1).logical_or_(blocks.narrow(axis, 1, size - 1))
        blocks = wider
    return blocks
