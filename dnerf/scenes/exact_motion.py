"""Exact motion vectors, occlusion and tracks of the surfaces of analytic scenes.

Bodies count as opaque here: a pixel shows the first surface its ray meets. In images they are fog of density 80
(or thin fog, in `pulsing_fog`), which absorbs light 1 / 80 of a unit deep on average.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.cameras import Camera, camera_rays
from dnerf.core.checks import check_shape
from dnerf.core.rays import Rays
from dnerf.scenes.base import AnalyticScene

HIDDEN_BY = 1e-6
"""How far in front of a point a surface must lie to hide it, in world units: rounding at grazing angles stays below."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the first surfaces that R rays meet."""

    positions: Tensor  # (R, 3) in world units; NaN where a ray meets nothing
    owners: Tensor  # (R,) int64, index of the body, -1 where a ray meets nothing
    distances: Tensor  # (R,) along the ray, infinite where it meets nothing


def first_surfaces(scene: AnalyticScene, rays: Rays) -> SurfacePoints:
    """Where R rays, each at its own time, first meet a body between `near` and `far`.

    A ray that begins in a body meets it where it begins.
    """
    distances = torch.full_like(rays.near, torch.inf)
    owners = torch.full(distances.shape, -1, device=distances.device)
    for index, (body, pose) in enumerate(scene.posed(rays.times)):
        enter, leave = body.spans(pose, rays)
        # A body that is not there at the time has no density.
        there = (leave > enter) & (body.density_at(pose) > 0)[:, None]
        enter = torch.where(there, enter, torch.inf).amin(-1)
        owners = torch.where(enter < distances, index, owners)
        distances = torch.minimum(enter, distances)
    positions = rays.origins + distances[:, None] * rays.directions
    return SurfacePoints(torch.where((owners >= 0)[:, None], positions, torch.nan), owners, distances)


def is_visible(scene: AnalyticScene, camera: Camera, time: float, positions: Tensor) -> Tensor:
    """Whether points (R, 3) on surfaces are in the image, between the planes and behind nothing; (R,) bool."""
    pixels, depths = camera.project(positions)
    size = torch.tensor([camera.intrinsics.width, camera.intrinsics.height], device=pixels.device)
    visible = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(-1) & (depths >= camera.near) & (depths <= camera.far)
    rows = visible.nonzero()[:, 0]
    eye = camera.pose[:3, 3].to(positions.dtype)
    offsets = positions[rows] - eye
    lengths = offsets.norm(dim=-1)
    near, times = camera.near / depths[rows] * lengths, torch.full_like(lengths, time)
    rays = Rays(eye.expand_as(offsets), offsets / lengths[:, None], times, near, lengths + 1)
    visible[rows] = first_surfaces(scene, rays).distances >= lengths - HIDDEN_BY
    return visible


@dataclass(frozen=True)
class ExactFlow:
    """Motion between two images of a scene.

    Vectors are pixels to the right and down from each pixel of the first image to where the same point is in the
    second, camera motion included.
    """

    vectors: Tensor  # (H, W, 2); NaN where a pixel shows no body
    visible: Tensor  # (H, W) bool, whether that point is visible in the second image too
    positions: Tensor  # (H, W, 3) of the point at the first time, in world units; NaN without one
    moved: Tensor  # (H, W, 3) of the same point at the second time
    moved_depth: Tensor  # (H, W) distance of the moved point from the second eye
    owners: Tensor  # (H, W) index of the body, -1 without one


def exact_flow(scene: AnalyticScene, first: Camera, t0: float, second: Camera, t1: float) -> ExactFlow:
    """Exact motion vectors and occlusion from one image to another.

    Args:
        scene: what moves.
        first: camera of the first image.
        t0: its time in [0, 1].
        second: camera of the second.
        t1: its time.
    """
    width, height = first.intrinsics.width, first.intrinsics.height
    columns, rows = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    here = torch.stack([columns, rows], dim=-1).reshape(-1, 2).to(first.pose.device, torch.float64)
    points = first_surfaces(scene, _precise_rays(first, t0, here))
    moved = scene.advect(points.positions, t0, t1, points.owners)
    there, _ = second.project(moved)
    visible = is_visible(scene, second, t1, moved)
    moved_depth = (moved - second.pose[:3, 3]).norm(dim=-1)
    # In the order of `ExactFlow`'s fields.
    values = (there - here, visible, points.positions, moved, moved_depth, points.owners)
    return ExactFlow(*(value.unflatten(0, (height, width)) for value in values))


@dataclass(frozen=True)
class ExactTracks:
    """N points of surfaces through T times."""

    positions: Tensor  # (T, N, 3) in world units
    pixels: Tensor  # (T, N, 2) column and row in the camera of each time
    visible: Tensor  # (T, N) bool


def exact_tracks(
    scene: AnalyticScene, cameras: Sequence[Camera], times: Sequence[float], pixels: Tensor
) -> ExactTracks:
    """Follow what is visible at some pixels of the first image through all times, exactly.

    Args:
        scene: what moves.
        cameras: T, one per time.
        times: T >= 1, in [0, 1], in any order.
        pixels: (P, 2) columns and rows in the first image; those that show no body are left out.

    Raises:
        ValueError: if numbers do not fit, or no pixel shows a body.
    """
    check_shape("pixels", pixels, ("P", 2))
    if len(cameras) != len(times) or not cameras:
        raise ValueError(f"cameras and times must be equally many and not none, got {len(cameras)} and {len(times)}")
    found = first_surfaces(scene, _precise_rays(cameras[0], times[0], pixels.double()))
    kept = found.owners >= 0
    if not bool(kept.any()):
        raise ValueError(f"pixels must show a body at time {times[0]}, none of {len(pixels)} does")
    start, owners = found.positions[kept], found.owners[kept]
    positions = [scene.advect(start, times[0], time, owners) for time in times]
    projected = [camera.project(moved)[0] for camera, moved in zip(cameras, positions)]
    visible = [is_visible(scene, *view) for view in zip(cameras, times, positions)]
    return ExactTracks(torch.stack(positions), torch.stack(projected), torch.stack(visible))


def _precise_rays(camera: Camera, time: float, pixels: Tensor) -> Rays:
    """Rays of float64 pixels (P, 2), which may be fractional."""
    pose, (columns, rows) = camera.pose.double(), pixels.unbind(-1)
    times = torch.full_like(columns, time)
    return camera_rays(camera.intrinsics, pose, columns, rows, times=times, near=camera.near, far=camera.far)
