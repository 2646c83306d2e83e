"""Exact frames of analytic scenes."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.cameras import Camera, Intrinsics, look_at
from dnerf.checks import check_positive
from dnerf.compositing import composite
from dnerf.data.frames import Frames
from dnerf.rays import Rays
from dnerf.scenes import AnalyticScene

DNERF_ANGLE_X = 0.6911112  # horizontal field of view of D-NeRF's cameras, in radians


def random_views(num_views: int, *, midway: bool = False, seed: int = 0, radius: float = 4.0) -> tuple[Tensor, Tensor]:
    """Cameras spread over the upper hemisphere and times spread over [0, 1].

    Args:
        num_views: F.
        midway: times (i + 1/2) / F rather than i / (F - 1).
        seed: of azimuths and elevations.
        radius: distance from the origin, in world units.

    Returns:
        poses (F, 4, 4) and times (F,).
    """
    check_positive("num_views", num_views)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(num_views, 2, generator=generator).tolist()
    poses = []
    for azimuth, height in uniform:
        angle, sine = 2 * math.pi * azimuth, 0.05 + 0.85 * height
        cosine = math.sqrt(1 - sine * sine)
        poses.append(look_at((radius * cosine * math.cos(angle), radius * cosine * math.sin(angle), radius * sine)))
    indices = torch.arange(num_views, dtype=torch.float32)
    times = (indices + 0.5) / num_views if midway else indices / max(num_views - 1, 1)
    return torch.stack(poses), times


def render_exact(
    scene: AnalyticScene, rays: Rays, background: Tensor | None = None, *, chunk: int = 16384
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (R, 3), opacity (R,) and expected depth (R,) of a scene along rays, exact to rounding.

    Args:
        scene: what is rendered.
        rays: R rays.
        background: (3,) colour behind the scene; None is black, which leaves premultiplied colour.
        chunk: rays at a time.
    """
    parts = []
    for i in range(0, len(rays), chunk):
        part = rays[i : i + chunk]
        samples = scene.exact_samples(part)
        output = scene(*samples.locate(part))
        parts.append(composite(samples, output, background))
    return (
        torch.cat([p.rgb for p in parts]),
        torch.cat([p.opacity for p in parts]),
        torch.cat([p.depth for p in parts]),
    )


@torch.no_grad()
def render_frames(
    scene: AnalyticScene,
    poses: Tensor,
    times: Tensor,
    resolution: int,
    *,
    background: Sequence[float] | None = None,
    angle_x: float = DNERF_ANGLE_X,
    near: float = 2.0,
    far: float = 6.0,
) -> Frames:
    """Render exact square frames, one ray through each pixel's centre.

    Args:
        scene: what is rendered.
        poses: (F, 4, 4) camera-to-world.
        times: (F,) in [0, 1].
        resolution: width and height in pixels.
        background: colour behind the frames, which then have no alpha; None keeps premultiplied alpha.
        angle_x: horizontal field of view in radians.
        near: z-depth where rays begin.
        far: z-depth where they end.
    """
    check_positive("resolution", resolution)
    intrinsics = Intrinsics.from_angle(resolution, resolution, angle_x)
    color = None if background is None else torch.tensor(background)
    channels = 4 if color is None else 3
    images = torch.empty(len(times), resolution, resolution, channels, dtype=torch.uint8)
    for i, (pose, time) in enumerate(zip(poses, times.tolist())):
        rgb, opacity, _ = render_exact(scene, Camera(intrinsics, pose, near, far).rays(time), color)
        pixels = rgb if color is not None else torch.cat([rgb, opacity[:, None]], dim=-1)
        images[i] = (pixels.clamp(0, 1) * 255).round().to(torch.uint8).reshape(images[i].shape)
    return Frames(
        images=images,
        poses=poses,
        times=times,
        intrinsics=intrinsics,
        near=near,
        far=far,
        background=None if background is None else tuple(background),
    )
