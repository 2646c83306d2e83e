"""Placing a data set in the world: its box, near and far, and the similarity, from cameras, silhouettes and points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics
from dnerf.core.geometry import box_planes
from dnerf.data.background_check import background_color
from dnerf.data.bounds import check_views, fit_box, opaque_without_room
from dnerf.data.frames import Frames
from dnerf.data.normalization import LONGEST_SIDE, Similarity, Vector, upright
from dnerf.data.scene_record import Box, World
from dnerf.data.viewpoints import Viewpoints, choose_up, common_focus, depths_of, planes_of, reach_around, unknown_parts

DIGITS = 4  # of the longest side, to which a fitted box is rounded, outwards
DISTANCE = 4.0  # world units from the cameras to what they look at, while the box is being fitted
TOO_NEAR = 0.02  # of the box's longest side, by which a given plane may cut into what images show
WITHOUT_ROOM = 1e-3  # share of opaque pixels that may look past a given box

FrameMaker = Callable[[Tensor, tuple[float, float]], Frames]


@dataclass(frozen=True)
class Given:
    """What the user or the files say of where the scene is, in the data set's own units; None finds it."""

    box: Tensor | None = None  # (2, 3) corners
    near: float | None = None  # z-depth
    far: float | None = None
    up: Vector | None = None
    planes: tuple[float, float] | None = None  # of the files: the box is fitted between them
    points: Tensor | None = None  # (N, 3) sparse points


def place(
    make_frames: FrameMaker, poses: Tensor, intrinsics: Sequence[Intrinsics], given: Given,
) -> World:  # fmt: skip
    """Place training frames in the world.

    Up is z, the fitted or given box stands at the origin with a longest side of 2.5. Everything is computed from
    cameras that have been moved and scaled roughly there, so that neither units nor where the data set's origin lies
    change the result by more than rounding.

    Args:
        make_frames: gives the frames of poses (F, 4, 4) float32 and z-depths near and far, all in the same units.
        poses: (F, 4, 4) float64 camera to world, in the data set's own units.
        intrinsics: F of them.

    Raises:
        ValueError: if no camera sees the box between its planes, or near is not before far.
    """
    views = Viewpoints.of(poses, intrinsics)
    up, up_by = choose_up(views, given.up)
    focus = common_focus(views)
    fitted = _fitted(make_frames, poses, views, focus, up, given)
    similarity, box = fitted if given.box is None else _given_box(given.box, up)
    near, far = (None if plane is None else plane * similarity.scale for plane in (given.near, given.far))
    world = World(box, similarity, planes=(near, far))
    world_poses = similarity.poses_to_world(poses).float()
    frames = make_frames(world_poses, planes_between(world_poses, world))
    check_views(frames, torch.tensor(box), similarity)
    doubts = [*_cut_off(frames, world, given, fitted), unknown_parts(views, focus), _beside_focus(views, focus, given)]
    return replace(
        world,
        notes=(_about_box(world, frames, given), _about_planes(frames, world), f"up: {_short(up)}, {up_by}"),
        warnings=tuple(said for said in doubts if said is not None),
    )


def _fitted(
    make_frames: FrameMaker, poses: Tensor, views: Viewpoints, focus: Tensor | None, up: Vector, given: Given
) -> tuple[Similarity, Box]:
    """The similarity and the box that images, points or cameras ask for, whatever box is given.

    Silhouettes say themselves where the scene ends; given planes only cut it off. Otherwise they say it. Cameras that
    go around something are amid what lies farther than that: the box is for what they go around.
    """
    near, far = _first_planes(views, focus, given)
    middle = (views.positions + 0.5 * (near + far) * views.forward).median(0).values if focus is None else focus
    x, y, z = middle.tolist()
    rough = Similarity(2 * DISTANCE / (near + far), upright(up), (x, y, z))
    frames = make_frames(rough.poses_to_world(poses).float(), (near * rough.scale, far * rough.scale))
    if not frames.is_transparent and background_color(frames) is None:
        if focus is not None:
            far = min(far, reach_around(views, focus))
        near = near if given.near is None else given.near
        far = far if given.far is None else given.far
        near, far = (near, far) if near < far else (near, 3 * near) if given.far is None else (far / 3, far)
        frames = replace(frames, near=near * rough.scale, far=far * rough.scale)
    points = None if given.points is None else rough.positions_to_world(given.points).float()
    return _in_world(fit_box(frames, points), rough)


def planes_between(poses: Tensor, world: World) -> tuple[float, float]:
    """z-depths in world units between which cameras (F, 4, 4) have the box, or those that were given.

    Raises:
        ValueError: if the given one is on the other side of the box.
    """
    depths = box_planes(poses, world.box)
    near, far = min(near for near, _ in depths), max(far for _, far in depths)
    near = near if world.planes[0] is None else world.planes[0]
    far = far if world.planes[1] is None else world.planes[1]
    if near >= far:
        scale = world.similarity.scale
        raise ValueError(
            f"near must be less than far, got {near / scale:.4g} and {far / scale:.4g}: the box lies elsewhere; leave "
            "data.near and data.far null to have them found"
        )
    return near, far


def _first_planes(views: Viewpoints, focus: Tensor | None, given: Given) -> tuple[float, float]:
    """Planes between which the box is sought: the files', unless most cameras look elsewhere; else the cameras'."""
    if given.planes is not None:
        depth = None if focus is None else float(depths_of(views, focus).median())
        if depth is None or given.planes[0] < depth < given.planes[1]:
            return given.planes
    near, far, _ = planes_of(views, given.points)
    return near, far


def _in_world(box: Tensor, rough: Similarity) -> tuple[Similarity, Box]:
    """The similarity and box of one that was fitted among roughly placed cameras."""
    low, high = box.double()
    sides = high - low
    x, y, z = rough.positions_from_world(0.5 * (low + high)).tolist()
    scale = LONGEST_SIDE / float(sides.max())
    unit = 10.0 ** (math.floor(math.log10(LONGEST_SIDE)) + 1 - DIGITS)
    halves = [math.ceil(round(0.5 * scale * side / unit, 6)) * unit for side in sides.tolist()]
    return Similarity(scale * rough.scale, rough.rotation, (x, y, z)), _around_origin(halves)


def _given_box(box: Tensor, up: Vector) -> tuple[Similarity, Box]:
    similarity = Similarity.of_box(box, up)
    low, high = similarity.box_to_world(box)
    return similarity, _around_origin((0.5 * (high - low)).tolist())


def _around_origin(halves: Sequence[float]) -> Box:
    x, y, z = (float(f"{half:.10g}") for half in halves)
    return (-x, -y, -z), (x, y, z)


def _about_box(world: World, frames: Frames, given: Given) -> str:
    if given.box is not None:
        by = "as given"
    elif given.points is not None and not frames.is_transparent:
        by = "fitted to sparse points"
    elif frames.is_transparent or background_color(frames) is not None:
        by = "fitted to what the images show"
    else:
        by = "fitted to what the cameras see"
    corners = ", ".join(_short(corner) for corner in world.similarity.box_from_world(world.box).tolist())
    return (
        f"box: [{corners}] in the data's units, {by}; its middle is the world's origin, one unit "
        f"{world.similarity.scale:.4g} of the world's"
    )


def _about_planes(frames: Frames, world: World) -> str:
    scale = world.similarity.scale
    near, far = (" (as given)" if plane is not None else "" for plane in world.planes)
    return f"planes: near {frames.near / scale:.4g}{near} and far {frames.far / scale:.4g}{far} in the data's units"


def _cut_off(frames: Frames, world: World, given: Given, fitted: tuple[Similarity, Box]) -> list[str]:
    """Where given settings leave out what images with alpha, or before one colour, show: sentences for warnings."""
    behind = None if frames.is_transparent else background_color(frames)
    if not frames.is_transparent and behind is None:
        return []
    said = []
    share = opaque_without_room(frames, torch.tensor(world.box), behind) if given.box is not None else 0.0
    if share > WITHOUT_ROOM:
        corners = ",".join(_short(corner).replace(" ", "") for corner in fitted[0].box_from_world(fitted[1]).tolist())
        said.append(
            f"{share:.1%} of the opaque pixels look past data.box, where nothing can explain them: set "
            f"data.box=[{corners}], or auto"
        )
    similarity, box = fitted
    poses = similarity.poses_to_world(world.similarity.poses_from_world(frames.poses))
    backward = poses[:, :3, 2]
    depths = (poses[:, :3, 3] * backward).sum(-1)
    # The ellipsoid in the box: in most scenes its corners are empty.
    reach = (torch.tensor(box[1], dtype=torch.float64) * backward).norm(dim=-1)
    first, last = (float(ends.median()) / similarity.scale for ends in (depths - reach, depths + reach))
    room = TOO_NEAR * LONGEST_SIDE / similarity.scale
    if given.near is not None and given.near > first + room:
        said.append(
            f"data.near={given.near:g} cuts off what the images show, which begins at about {first:.3g}: set "
            f"data.near={0.9 * max(first, 0):.3g}, or null"
        )
    if given.far is not None and given.far < last - room:
        said.append(
            f"data.far={given.far:g} cuts off what the images show, which ends at about {last:.3g}: set "
            f"data.far={1.1 * last:.3g}, or null"
        )
    return said


def _beside_focus(views: Viewpoints, focus: Tensor | None, given: Given) -> str | None:
    """Whether what the cameras look at is before or behind the given planes, as a sentence for a warning."""
    if focus is None:
        return None
    depth = float(depths_of(views, focus).median())
    if given.near is not None and depth <= given.near:
        plane = f"data.near={given.near:g} lies behind"
    elif given.far is not None and depth >= given.far:
        plane = f"data.far={given.far:g} lies before"
    else:
        return None
    return f"{plane} what the cameras look at, in a depth of {depth:.3g}: set it to null"


def _short(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
