"""Boxes that are far too large for what is in them: noticed early in training, so that it can begin anew in less."""

import logging

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from dnerf.checks import check_positive
from dnerf.data.frames import Frames
from dnerf.geometry import ray_box
from dnerf.renderer import Renderer

logger = logging.getLogger(__name__)

SHRINK_AT_ONCE = 0.9  # of the box's longest side: beginning anew before the first step costs nothing
CUT_SHARE = 3e-3  # of a face's cells: fewer are haze
EVERY_PIXEL = 3  # in rows and columns, of those that are asked for matter outside of a box
BLOCK = 2  # cells of which views are asked at once: an eighth of the work


class BoxTooLarge(Exception):
    """What training found lies in a small part of the box; a model with `box` shows it in finer cells.

    Args:
        step: after which it was seen.
        seconds: of training until then.
        box: (2, 3) corners that are enough, in world units.
    """

    def __init__(self, step: int, seconds: float, box: list[list[float]]) -> None:
        super().__init__(f"step {step}: matter fills a small part of the box, {box} is enough")
        self.step = step
        self.seconds = seconds
        self.box = box


class BoxCheck:
    """Looks early in training how much of the box matter needs.

    Grids, lattices and occupancy share out a fixed number of cells, so a box four times as long means cells four times
    as long and a blurred picture. Before the first step it is known what the cameras see, after a few hundred steps
    what is occupied. If that is much smaller than the box, all that is lost by beginning anew in a smaller one is those
    steps. Nothing that is seen and occupied at any time lies outside the smaller one, and where pictures have alpha, no
    opaque pixel looks past it: small bodies that move fast may not have been found yet.

    Args:
        every: steps between checks.
        until: last step at which one is made: haze of a large box takes its time to go. For pictures without alpha
            steps count from when all frames are in.
        until_spent: share of the seconds that training may take, in [0, 1], after which none is made: what is left has
            to be worth beginning anew.
        shrink_below: longest side of what is needed, as a share of the box's, in (0, 1), below which the box is too
            large; before the first step, when nothing is lost, `SHRINK_AT_ONCE`.
        min_views: share of the training views, in [0, 1), that see a place which counts: where fewer look, a field may
            hold anything. See `share_of_views`.
        room: left at each face around matter, as a share of the longest side: its ends may not have been found yet.

    Raises:
        ValueError: for numbers out of range.
    """

    def __init__(
        self,
        every: int = 32,
        until: int = 512,
        *,
        until_spent: float = 0.4,
        shrink_below: float = 0.5,
        min_views: float = 0.05,
        room: float = 0.1,
    ) -> None:
        for name, value in (("every", every), ("until", until), ("shrink_below", shrink_below)):
            check_positive(name, value)
        for name, value in (("until_spent", until_spent), ("min_views", min_views), ("room", room)):
            check_positive(name, value, allow_zero=True)
        if until_spent > 1:
            raise ValueError(f"until_spent must be in [0, 1], got {until_spent}")
        if shrink_below >= 1:
            raise ValueError(f"shrink_below must be in (0, 1), got {shrink_below}")
        if min_views >= 1:
            raise ValueError(f"min_views must be in [0, 1), got {min_views}")
        self.every = every
        self.until = until
        self.until_spent = until_spent
        self.shrink_below = shrink_below
        self.min_views = min_views
        self.room = room

    def __call__(
        self,
        step: int,
        seconds: float,
        renderer: Renderer,
        frames: Frames,
        *,
        with_all_frames: float | None,
        max_seconds: float | None = None,
    ) -> None:
        """Check, if it is time.

        While frames come in by time, matter may go elsewhere at times that are not in yet. Opaque pixels of their
        pictures tell of it; for pictures without alpha the check waits, and counts its steps from when all are in.

        Args:
            step: steps done; the sampler has learnt from the field since the last one.
            seconds: of training so far.
            renderer: in training.
            frames: of the training.
            with_all_frames: steps of them that all frames took part in, or None if some are still to come.
            max_seconds: that training may take, or None.

        Raises:
            BoxTooLarge: with the box that is enough.
        """
        counted = step if frames.has_alpha or not step else with_all_frames
        if step % self.every or counted is None or counted > self.until:
            return
        if step and max_seconds is not None and seconds > self.until_spent * max_seconds:
            return
        box = self.smaller(renderer, frames, of_matter=step > 0)
        if box is not None:
            raise BoxTooLarge(step, seconds, box.tolist())

    def smaller(self, renderer: Renderer, frames: Frames, *, of_matter: bool) -> Tensor | None:
        """Corners (2, 3) of the box that is enough, or None if it is not much smaller.

        Args:
            renderer: whose sampler is asked where matter is; one that does not know needs all of its box.
            frames: of the training.
            of_matter: whether it is to be enough for matter; otherwise for what the cameras reach, or, if that is
                nearly all of the box, for what enough of them see.
        """
        known = renderer.sampler.cells_at_any_time()
        if known is None:
            return None
        box, mask = (values.cpu() for values in known)
        # Cells of a box that is larger by far are too long to tell what views see.
        reached = None if of_matter else _within(box, reach(frames).cpu(), SHRINK_AT_ONCE)
        if reached is not None:
            return reached
        cells = self._seen(frames, box, mask if of_matter else torch.ones_like(mask)).nonzero()
        if not len(cells):
            return None
        corners = torch.lerp(box[0], box[1], torch.stack([cells.amin(0), cells.amax(0) + 1]) / torch.tensor(mask.shape))
        if not of_matter:
            return _within(box, corners, SHRINK_AT_ONCE)
        smaller = _within(box, corners, self.shrink_below, self.room)
        return None if smaller is None or shows_outside(frames, smaller) else smaller

    def warn(self, step: int, renderer: Renderer, frames: Frames) -> None:
        """Log a warning that names the faces that `cut` finds, after `until` steps: before, it may be haze.

        Args:
            step: steps done.
            renderer: trained.
            frames: of the training.
        """
        if step >= self.until and (faces := self.cut(renderer, frames)):
            logger.warning(
                "matter reaches the box at %s: what lies beyond is never sampled, see data.box", ", ".join(faces)
            )

    def cut(self, renderer: Renderer, frames: Frames) -> list[str]:
        """Faces of the box at which matter ends, such as "x=-1.5": what lies beyond them no ray samples.

        Args:
            renderer: trained; a sampler that does not know where matter is tells of none.
            frames: of the training.
        """
        known = renderer.sampler.cells_at_any_time()
        if known is None:
            return []
        box, mask = (values.cpu() for values in known)
        outer = mask.clone()
        outer[1:-1, 1:-1, 1:-1] = False
        seen = self._seen(frames, box, outer)
        return [
            f"{name}={float(box[end, axis]):.4g}"
            for axis, name in enumerate("xyz")
            for end in (0, 1)
            if seen.select(axis, -end).float().mean() > CUT_SHARE
        ]

    def _seen(self, frames: Frames, box: Tensor, mask: Tensor) -> Tensor:
        """The cells (Gx, Gy, Gz) of a mask that enough views see; they are asked for blocks of cells."""
        blocks = max_pool3d(mask[None, None].float(), BLOCK, ceil_mode=True)[0, 0] > 0
        centers = torch.lerp(box[0], box[1], (blocks.nonzero() + 0.5) * BLOCK / torch.tensor(mask.shape))
        share = share_of_views(frames, centers.to(frames.poses.device)).cpu()
        blocks[blocks.clone()] = share >= self.min_views
        for axis, count in enumerate(mask.shape):
            blocks = blocks.repeat_interleave(BLOCK, axis).narrow(axis, 0, count)
        return mask & blocks


def _within(box: Tensor, corners: Tensor, shrink_below: float, room: float = 0.0) -> Tensor | None:
    """The part of a box within corners, if that is much shorter, with room around it; None if it is not."""
    needed = torch.minimum(torch.maximum(corners, box[0]), box[1])
    side = (needed[1] - needed[0]).max()
    if not 0 < side < shrink_below * (box[1] - box[0]).max():
        return None
    return torch.minimum(torch.maximum(needed + room * side * needed.new_tensor([[-1.0], [1.0]]), box[0]), box[1])


def reach(frames: Frames) -> Tensor:
    """Corners (2, 3) of the smallest box that holds what views show between their planes."""
    width, height = frames.intrinsics.width, frames.intrinsics.height
    corners = torch.tensor([0, width - 1, width * (height - 1), width * height - 1], device=frames.poses.device)
    ends = []
    for index in range(len(frames)):
        rays = frames.camera(index).rays(0.0, corners)
        ends += [rays.origins + distances[:, None] * rays.directions for distances in (rays.near, rays.far)]
    places = torch.cat(ends)
    return torch.stack([places.amin(0), places.amax(0)])


def check_views(frames: Frames, box: Tensor) -> None:
    """Raise unless some pixel's ray is in the box between the planes: otherwise there is nothing to learn from.

    One of `EVERY_PIXEL` squared pixels of each view is asked.

    Args:
        frames: of the training.
        box: (2, 3) corners, in world units.

    Raises:
        ValueError: naming the box, the planes and where the cameras' rays are between them.
    """
    box = box.to(frames.poses.device)
    width, height = frames.intrinsics.width, frames.intrinsics.height
    rows, columns = (torch.arange(0, size, EVERY_PIXEL, device=box.device) for size in (height, width))
    pixels = (width * rows[:, None] + columns).reshape(-1)
    for index in range(len(frames)):
        rays = frames.camera(index).rays(0.0, pixels)
        enter, leave = ray_box(rays.origins, rays.directions, box)
        if bool((enter.maximum(rays.near) < leave.minimum(rays.far)).any()):
            return
    raise ValueError(
        f"box must be seen by some camera between near {frames.near:g} and far {frames.far:g}, got {box.tolist()}; "
        f"what cameras see there lies within {reach(frames).tolist()}: other units, or another data.box, data.near or "
        "data.far, are meant"
    )


def shows_outside(frames: Frames, box: Tensor) -> bool:
    """Whether an opaque pixel looks past a box (2, 3), so that matter lies outside; pictures without alpha do not tell.

    One of `EVERY_PIXEL` squared pixels of each view is asked.
    """
    if not frames.has_alpha:
        return False
    box = box.to(frames.poses.device)
    for index in range(len(frames)):
        rows, columns = (frames.images[index, ::EVERY_PIXEL, ::EVERY_PIXEL, 3] >= 128).nonzero().unbind(-1)
        rays = frames.camera(index).rays(0.0, EVERY_PIXEL * (rows * frames.intrinsics.width + columns))
        enter, leave = ray_box(rays.origins, rays.directions, box)
        if bool(((enter > leave) | (leave < rays.near) | (enter > rays.far)).any()):
            return True
    return False


def share_of_views(frames: Frames, positions: Tensor, most: int = 32) -> Tensor:
    """The share (N,) of views between whose planes, and within whose picture, positions (N, 3) lie.

    Args:
        frames: with the views.
        positions: in world units.
        most: views that are asked, evenly spread over all.
    """
    count = min(most, len(frames))
    width, height = frames.intrinsics.width, frames.intrinsics.height
    seen = torch.zeros(len(positions), device=positions.device)
    for index in torch.linspace(0, len(frames) - 1, count).round().long().tolist():
        pixels, depth = frames.camera(index).project(positions)
        x, y = pixels.unbind(-1)
        is_between = (frames.near <= depth) & (depth <= frames.far)
        seen += is_between & (x > -1) & (x < width) & (y > -1) & (y < height)
    return seen / count
