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
    scene: AnalyticScene, poses: Tensor, times: Tensor, lens: int | Intrinsics, *,
    background: Sequence[float] | None = None, gains: Tensor | None = None, planes: tuple[float, float] = (2.0, 6.0),
    oversampling: int = 1,
) -> Frames:  # fmt: skip
    """Render exact frames, one ray through each pixel's centre.

    Args:
        poses: (F, 4, 4) camera-to-world.
        times: (F,) in [0, 1].
        lens: of all frames; or the width of square ones with the field of view of D-NeRF's cameras.
        background: colour behind the frames, which then have no alpha; None keeps premultiplied alpha.
        gains: (F, 3) factors of the colours, as of an exposure that drifts; None for 1.
        planes: z-depths near and far.
        oversampling: pixels are averages of this squared.
    """
    check_positive("oversampling", oversampling)
    if isinstance(lens, int):
        check_positive("lens", lens)
        lens = Intrinsics.from_angle(lens, lens, DNERF_ANGLE_X)
    color = None if background is None else torch.tensor(background)
    channels, n = 4 if color is None else 3, oversampling
    fine = lens.resized(n * lens.width, n * lens.height)
    images = torch.empty(len(times), lens.height, lens.width, channels, dtype=torch.uint8)
    for i, (pose, time) in enumerate(zip(poses, times.tolist())):
        rgb, opacity, _ = render_exact(scene, Camera(fine, pose, *planes).rays(time), color)
        if gains is not None:
            rgb = rgb * gains[i]
        pixels = rgb if color is not None else torch.cat([rgb, opacity[:, None]], dim=-1)
        pixels = pixels.clamp(0, 1).reshape(lens.height, n, lens.width, n, channels).mean((1, 3))
        images[i] = (pixels * 255).round().to(torch.uint8)
    stated = None if background is None or gains is not None else tuple(background)
    return Frames(images, poses, times, lens, *planes, background=stated)
