"""Exact frames of analytic scenes."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics, look_at
from dnerf.core.checks import check_positive
from dnerf.core.compositing import composite
from dnerf.core.rays import Rays
from dnerf.data.frames import Frames
from dnerf.scenes import AnalyticScene

DNERF_ANGLE_X = 0.6911112  # horizontal field of view of D-NeRF's cameras, in radians
RADIUS = 4.0  # of its hemisphere of cameras
CHUNK = 16384  # rays at a time


def random_views(num_views: int, *, midway: bool = False, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Poses (F, 4, 4) spread over the upper hemisphere of radius 4 and times (F,) spread over [0, 1].

    Times are i / (F - 1), or (i + 1/2) / F if `midway`.
    """
    check_positive("num_views", num_views)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(num_views, 2, generator=generator).tolist()
    poses = []
    for azimuth, height in uniform:
        angle, sine = 2 * math.pi * azimuth, 0.05 + 0.85 * height
        cosine = math.sqrt(1 - sine * sine)
        poses.append(look_at((RADIUS * cosine * math.cos(angle), RADIUS * cosine * math.sin(angle), RADIUS * sine)))
    indices = torch.arange(num_views, dtype=torch.float32)
    times = (indices + 0.5) / num_views if midway else indices / max(num_views - 1, 1)
    return torch.stack(poses), times


def render_exact(scene: AnalyticScene, rays: Rays, background: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (R, 3), opacity (R,) and expected depth (R,) of a scene along rays, exact to rounding.

    The colour (3,) behind the scene is `background`; None is black, which leaves premultiplied colour.
    """
    parts = []
    for i in range(0, len(rays), CHUNK):
        part = rays[i : i + CHUNK]
        samples = scene.exact_samples(part)
        rendering = composite(samples, scene(*samples.locate(part)), background)
        parts.append((rendering.rgb, rendering.opacity, rendering.depth))
    rgb, opacity, depth = map(torch.cat, zip(*parts))
    return rgb, opacity, depth


@torch.no_grad()
def render_frames(
    scene: AnalyticScene,
    poses: Tensor,
    times: Tensor,
    resolution: int,
    *,
    background: Sequence[float] | None = None,
) -> Frames:
    """Render exact square frames, one ray through each pixel's centre, with the field of view of D-NeRF's cameras.

    Args:
        poses: (F, 4, 4) camera-to-world.
        times: (F,) in [0, 1].
        background: colour behind the frames, which then have no alpha; None keeps premultiplied alpha.
    """
    check_positive("resolution", resolution)
    intrinsics = Intrinsics.from_angle(resolution, resolution, DNERF_ANGLE_X)
    color = None if background is None else torch.tensor(background)
    channels = 4 if color is None else 3
    images = torch.empty(len(times), resolution, resolution, channels, dtype=torch.uint8)
    for i, (pose, time) in enumerate(zip(poses, times.tolist())):
        rgb, opacity, _ = render_exact(scene, Camera(intrinsics, pose).rays(time), color)
        pixels = rgb if color is not None else torch.cat([rgb, opacity[:, None]], dim=-1)
        images[i] = (pixels.clamp(0, 1) * 255).round().to(torch.uint8).reshape(images[i].shape)
    return Frames(images, poses, times, intrinsics, background=None if background is None else tuple(background))
