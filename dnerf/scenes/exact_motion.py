"""What is seen moves exactly: motion vectors, occlusion and tracks of the surfaces of analytic scenes.

Bodies count as opaque here: a pixel shows the first surface its ray meets. In the pictures they are fog of density 80
(or thin fog, in `pulsing_fog`), which is seen 1 / 80 of a unit deep on average.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.cameras import Camera, camera_rays
from dnerf.checks import check_shape
from dnerf.rays import Rays
from dnerf.scenes.base import AnalyticScene
from dnerf.scenes.motions import world_poses
from dnerf.scenes.poses import Pose

HIDDEN_BY = 1e-6
"""How far in front of a point a surface must lie to hide it, in world units: rounding at grazing angles stays below."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the first surfaces that R rays meet.

    Args:
        positions: (R, 3) in world units; NaN where a ray meets nothing.
        owners: (R,) int64, index of the body, -1 where a ray meets nothing.
        distances: (R,) along the ray, infinite where it meets nothing.
    """

    positions: Tensor
    owners: Tensor
    distances: Tensor


def first_surfaces(scene: AnalyticScene, rays: Rays) -> SurfacePoints:
    """Where R rays, each at its own time, first meet matter between `near` and `far`.

    A ray that begins in matter meets it where it begins.
    """
    distances = torch.full_like(rays.near, torch.inf)
    owners = torch.full(distances.shape, -1, device=distances.device)
    for index, (body, pose) in enumerate(zip(scene.bodies, _poses(scene, rays.times))):
        enter, leave = body.spans(pose, rays.origins, rays.directions, rays.near, rays.far)
        enter, leave = torch.maximum(enter, rays.near[:, None]), torch.minimum(leave, rays.far[:, None])
        # A body that is not there at the time has no density.
        there = (leave > enter) & (body.density_at(pose) > 0)[:, None]
        enter = torch.where(there, enter, torch.inf).amin(-1)
        nearer = enter < distances
        distances = torch.where(nearer, enter, distances)
        owners = torch.where(nearer, index, owners)
    positions = rays.origins + distances[:, None] * rays.directions
    return SurfacePoints(torch.where((owners >= 0)[:, None], positions, torch.nan), owners, distances)


def carry_points(scene: AnalyticScene, points: SurfacePoints, t0: Tensor, t1: Tensor) -> Tensor:
    """Positions (R, 3) at times t1 (R,) of points of known bodies at times t0 (R,), exactly; NaN where there are none.

    Unlike `AnalyticScene.advect` it does not ask who holds the points, which rounding decides on a surface.
    """
    moved = torch.full_like(points.positions, torch.nan)
    for index, (old, new) in enumerate(zip(_poses(scene, t0), _poses(scene, t1))):
        own = (points.owners == index)[:, None]
        moved = torch.where(own, new.to_world(old.to_local(points.positions)), moved)
    return moved


def is_visible(scene: AnalyticScene, camera: Camera, time: float, positions: Tensor) -> Tensor:
    """Whether points (R, 3) on surfaces are seen: within the picture and the planes, nothing in front; (R,) bool."""
    pixels, depths = camera.project(positions)
    size = torch.tensor([camera.intrinsics.width, camera.intrinsics.height], device=pixels.device)
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1) & (depths >= camera.near) & (depths <= camera.far)
    eye = camera.pose[:3, 3].to(positions.dtype)
    offsets = torch.where(inside[:, None], positions - eye, torch.ones_like(positions))
    lengths = offsets.norm(dim=-1)
    times = torch.full_like(lengths, time)
    near = camera.near / torch.where(inside, depths, 1.0) * lengths
    rays = Rays(eye.expand_as(offsets), offsets / lengths[:, None], times, near, lengths + 1)
    return inside & (first_surfaces(scene, rays).distances >= lengths - HIDDEN_BY)


@dataclass(frozen=True)
class ExactFlow:
    """Motion between two pictures of a scene.

    Args:
        vectors: (H, W, 2) pixels to the right and down from each pixel of the first picture to where the same matter is
            in the second, camera motion included; NaN where a pixel shows no matter.
        visible: (H, W) bool, whether that matter is seen in the second picture too.
        positions: (H, W, 3) of the matter at the first time, in world units; NaN without matter.
        moved: (H, W, 3) of the same matter at the second time.
        depth: (H, W) distance of the matter from the first eye; NaN without matter.
        moved_depth: (H, W) distance of the moved matter from the second eye.
        owners: (H, W) index of the body, -1 without matter.
    """

    vectors: Tensor
    visible: Tensor
    positions: Tensor
    moved: Tensor
    depth: Tensor
    moved_depth: Tensor
    owners: Tensor


def exact_flow(
    scene: AnalyticScene, first: Camera, t0: float, second: Camera, t1: float, *, dtype: torch.dtype = torch.float64
) -> ExactFlow:
    """Exact motion vectors and occlusion from one picture to another.

    Args:
        scene: what moves.
        first: camera of the first picture.
        t0: its time in [0, 1].
        second: camera of the second.
        t1: its time.
        dtype: of the computation.
    """
    shape = (first.intrinsics.height, first.intrinsics.width)
    rays = _precise_rays(first, t0, dtype)
    points = first_surfaces(scene, rays)
    later = torch.full_like(rays.times, t1)
    moved = carry_points(scene, points, rays.times, later)
    there, _ = second.project(moved)
    here = _pixel_grid(first, dtype)
    matter = points.owners >= 0
    visible = torch.zeros_like(matter)
    visible[matter] = is_visible(scene, second, t1, moved[matter])
    eye = second.pose[:3, 3].to(dtype)
    return ExactFlow(
        vectors=(there - here).reshape(*shape, 2),
        visible=visible.reshape(shape),
        positions=points.positions.reshape(*shape, 3),
        moved=moved.reshape(*shape, 3),
        depth=torch.where(matter, points.distances, torch.nan).reshape(shape),
        moved_depth=(moved - eye).norm(dim=-1).reshape(shape),
        owners=points.owners.reshape(shape),
    )


@dataclass(frozen=True)
class ExactTracks:
    """N points of surfaces through T times.

    Args:
        positions: (T, N, 3) in world units.
        pixels: (T, N, 2) column and row in the camera of each time.
        visible: (T, N) bool.
        times: T.
    """

    positions: Tensor
    pixels: Tensor
    visible: Tensor
    times: tuple[float, ...]


def exact_tracks(
    scene: AnalyticScene, cameras: Sequence[Camera], times: Sequence[float], pixels: Tensor
) -> ExactTracks:
    """Follow what is seen at some pixels of the first picture through all times, exactly.

    Args:
        scene: what moves.
        cameras: T, one per time.
        times: T >= 1, in [0, 1], in any order.
        pixels: (P, 2) columns and rows in the first picture; those that show no matter are left out.

    Raises:
        ValueError: if numbers do not fit, or no pixel shows matter.
    """
    check_shape("pixels", pixels, ("P", 2))
    if len(cameras) != len(times) or not cameras:
        raise ValueError(f"cameras and times must be equally many and not none, got {len(cameras)} and {len(times)}")
    rays = _precise_rays(cameras[0], times[0], torch.float64, pixels)
    found = first_surfaces(scene, rays)
    kept = found.owners >= 0
    if not bool(kept.any()):
        raise ValueError(f"pixels must show matter at time {times[0]}, none of {len(pixels)} does")
    points = SurfacePoints(found.positions[kept], found.owners[kept], found.distances[kept])
    start = torch.full_like(points.distances, times[0])
    places, projected, seen = [], [], []
    for camera, time in zip(cameras, times):
        moved = carry_points(scene, points, start, torch.full_like(start, time))
        places.append(moved)
        projected.append(camera.project(moved)[0])
        seen.append(is_visible(scene, camera, time, moved))
    return ExactTracks(torch.stack(places), torch.stack(projected), torch.stack(seen), tuple(times))


def _poses(scene: AnalyticScene, times: Tensor) -> list[Pose]:
    """Each body's poses at times (R,): R of them, or one if all times are the same."""
    distinct, index = torch.unique(times, return_inverse=True)
    return [pose.take(index) for pose in world_poses([body.motion for body in scene.bodies], distinct)]


def _pixel_grid(camera: Camera, dtype: torch.dtype) -> Tensor:
    """Column and row of every pixel in row order, (H * W, 2)."""
    pixels = torch.arange(camera.intrinsics.height * camera.intrinsics.width, device=camera.pose.device)
    return torch.stack([pixels % camera.intrinsics.width, pixels // camera.intrinsics.width], dim=-1).to(dtype)


def _precise_rays(camera: Camera, time: float, dtype: torch.dtype, pixels: Tensor | None = None) -> Rays:
    """Rays of pixels (P, 2), which may be fractional (all pixels if None), computed in the given precision."""
    pixels = _pixel_grid(camera, dtype) if pixels is None else pixels.to(dtype)
    times = torch.full((len(pixels),), time, dtype=dtype, device=pixels.device)
    return camera_rays(
        camera.intrinsics, camera.pose.to(dtype), pixels[:, 0], pixels[:, 1], times=times, near=camera.near,
        far=camera.far,
    )  # fmt: skip
