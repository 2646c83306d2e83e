"""The box of a scene: found from the training frames before the first step, and checked afterwards."""

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from dnerf.core.checks import check_shape
from dnerf.core.geometry import ray_box
from dnerf.data.background_check import background_color
from dnerf.data.carving import EVERY_PIXEL, Silhouettes, carve, hold_opaque, opaque_rays
from dnerf.data.frames import Frames
from dnerf.data.normalization import IDENTITY, Similarity
from dnerf.data.pixel_layout import evenly_spread
from dnerf.samplers import OccupiedCells

ROOM = 0.03  # at each face, of the longest side: surfaces are softer in training than they are
FEW_POINTS = 8  # fewer have no extent to speak of
ROOM_AROUND_POINTS = 0.15  # they are few, and none lie on what moves
QUANTILE = 0.01  # of sparse points, at either end of each axis, that may be wrong
SHARES = (0.5, 0.1, 0.0)  # of the views, that see what the box has to hold: the first that is enough
MUCH_SMALLER = 0.5  # of the longest side: then distances along rays are worth dividing anew
MAX_VIEWS = 200  # evenly spread, whose rays say what cameras see
LOOKED_AT = 32  # views, evenly spread, that say how many see a place
CUT_SHARE = 3e-3  # of a face's cells: fewer are floaters
MIN_VIEWS = 0.05  # share of the views that see a cell which counts: where fewer look, a field may hold anything
BLOCK = 2  # cells that are projected as one: an eighth of the work


def fit_box(frames: Frames, points: Tensor | None = None) -> Tensor:
    """The box that a model of training frames needs: (2, 3) lowest and highest corner, in world units.

    Grids and occupancy share out a fixed number of cells, so the box should be as small as it can; what lies outside is
    never sampled, so it is too large rather than too small.

    - Images with alpha: what their opaque pixels can show (`carve`), with room around it. No opaque pixel looks past
      the box.
    - Otherwise sparse points, if there are any: what holds nearly all of those that a tenth of the cameras see between
      their planes, with more room.
    - Otherwise, if one colour is behind the scene, the same as with alpha, of the pixels that have another one.
    - Otherwise what a tenth of the cameras see between their planes: the images show something everywhere.

    Args:
        points: (N, 3) on surfaces, for example of structure from motion, in world units; None if there are none.
            ValueError for another shape, or if none is finite.
    """
    if frames.is_transparent:
        return _with_room(hold_opaque(frames, _carved(frames, None)), ROOM)
    if points is not None:
        check_shape("points", points, ("N", 3))
        points = points[points.isfinite().all(-1)]
        if not len(points):
            raise ValueError("points must hold a finite one, got none")
        share = share_of_views(frames, points)
        seen = points[share >= SHARES[1] * share.max()]
        points = seen if len(seen) >= FEW_POINTS else points
        ends = torch.tensor([QUANTILE, 1 - QUANTILE], dtype=points.dtype, device=points.device)
        return _with_room(torch.quantile(points, ends, dim=0), ROOM_AROUND_POINTS)
    behind = background_color(frames)
    if behind is not None:
        return _with_room(hold_opaque(frames, _carved(frames, behind), behind), ROOM)
    return seen_box(frames, SHARES[1])


def _carved(frames: Frames, behind: Tensor | None) -> Tensor:
    """What opaque pixels can show, within what enough cameras see."""
    silhouettes = Silhouettes.of(frames, behind)
    for share in SHARES:
        box = seen_box(frames, share)
        while (smaller := carve(silhouettes, box)) is not None:
            done = _side(smaller) > MUCH_SMALLER * _side(box)
            box = smaller
            if done:
                return box
    return box


def _side(box: Tensor) -> float:
    return float((box[1] - box[0]).max())


def _with_room(box: Tensor, room: float) -> Tensor:
    return box + room * max(_side(box), 1e-6) * box.new_tensor([[-1.0], [1.0]])


def seen_box(frames: Frames, share: float) -> Tensor:
    """Corners (2, 3) of what a share of the cameras see between their planes.

    The share is of the cameras that see the place which most of them see; 0 for what any sees.
    """
    steps = torch.linspace(0, 1, 32, device=frames.poses.device)
    positions = []
    for index in evenly_spread(len(frames), MAX_VIEWS):
        height, width = frames.layout.sizes[index]
        rows, columns = (torch.linspace(0, size - 1, 4, device=steps.device).round() for size in (height, width))
        rays = frames.camera(index).rays(0.0, (width * rows[:, None] + columns).reshape(-1).long())
        begin = rays.near.maximum(1e-3 * rays.far)[:, None]  # a logarithm needs one
        distances = begin * (rays.far[:, None] / begin) ** steps
        positions.append((rays.origins[:, None] + distances[..., None] * rays.directions[:, None]).flatten(0, 1))
    places = torch.cat(positions)
    if share > 0:
        seen = share_of_views(frames, places)
        places = places[seen >= share * seen.max()]
    return torch.stack([places.amin(0), places.amax(0)])


def share_of_views(frames: Frames, positions: Tensor) -> Tensor:
    """The share (N,) of views between whose planes, and within whose image, positions (N, 3) in world units lie."""
    chosen = evenly_spread(len(frames), LOOKED_AT)
    seen = torch.zeros(len(positions), device=positions.device)
    for index in chosen:
        height, width = frames.layout.sizes[index]
        pixels, depth = frames.camera(index).project(positions)
        x, y = pixels.unbind(-1)
        is_between = (frames.near <= depth) & (depth <= frames.far)
        seen += is_between & (x > -1) & (x < width) & (y > -1) & (y < height)
    return seen / len(chosen)


def check_views(frames: Frames, box: Tensor, similarity: Similarity = IDENTITY) -> None:
    """Raise unless some pixel's ray is in the box (2, 3) between the planes: otherwise there is nothing to learn from.

    One of `EVERY_PIXEL` squared pixels of each view is looked at. The ValueError names the box, the planes and where
    the cameras' rays are between them, in the data set's own units.
    """
    box = box.to(frames.poses.device)
    for index, (height, width) in enumerate(frames.layout.sizes):
        rows, columns = (torch.arange(0, size, EVERY_PIXEL, device=box.device) for size in (height, width))
        rays = frames.camera(index).rays(0.0, (width * rows[:, None] + columns).reshape(-1))
        enter, leave = ray_box(rays.origins, rays.directions, box)
        if bool((enter.maximum(rays.near) < leave.minimum(rays.far)).any()):
            return
    near, far = frames.near / similarity.scale, frames.far / similarity.scale
    own, seen = (similarity.box_from_world(corners).float().tolist() for corners in (box, seen_box(frames, 0)))
    raise ValueError(
        f"box must be seen by some camera between near {near:g} and far {far:g}, got {own}; what cameras see there "
        f"lies within {seen}: other units, or another data.box, data.near or data.far, are meant"
    )


def opaque_without_room(frames: Frames, box: Tensor, behind: Tensor | None = None) -> float:
    """The share of opaque pixels whose rays miss the box (2, 3) between the planes: nothing can explain them.

    Images have alpha, or a colour (3,) in [0, 1] behind them. One of `EVERY_PIXEL` squared pixels of each view is
    looked at.
    """
    count = missed = 0
    for index in range(len(frames)):
        rays = opaque_rays(frames, index, behind)
        enter, leave = ray_box(rays.origins, rays.directions, box.to(rays.origins))
        missed += int((enter.maximum(rays.near) >= leave.minimum(rays.far)).sum())
        count += len(rays)
    return missed / max(count, 1)


def cut_faces(cells: OccupiedCells, frames: Frames, min_views: float = MIN_VIEWS) -> list[str]:
    """Faces of the box that geometry reaches, such as "x=-1.5": what lies beyond them no ray samples.

    Cells are those occupied at any time, after training; they count if `min_views`, a share in [0, 1), see them.
    """
    box, mask = cells.box.cpu(), cells.mask.cpu()
    outer = mask.clone()
    outer[1:-1, 1:-1, 1:-1] = False
    seen = _seen(frames, box, outer, min_views)
    return [
        f"{name}={float(box[end, axis]):.4g}"
        for axis, name in enumerate("xyz")
        for end in (0, 1)
        if seen.select(axis, -end).float().mean() > CUT_SHARE
    ]


def _seen(frames: Frames, box: Tensor, mask: Tensor, min_views: float) -> Tensor:
    """The cells (Gx, Gy, Gz) of a mask that enough views see, decided by blocks of cells."""
    blocks = max_pool3d(mask[None, None].float(), BLOCK, ceil_mode=True)[0, 0] > 0
    centers = torch.lerp(box[0], box[1], (blocks.nonzero() + 0.5) * BLOCK / torch.tensor(mask.shape))
    share = share_of_views(frames, centers.to(frames.poses.device)).cpu()
    blocks[blocks.clone()] = share >= min_views
    for axis, count in enumerate(mask.shape):
        blocks = blocks.repeat_interleave(BLOCK, axis).narrow(axis, 0, count)
    return mask & blocks
