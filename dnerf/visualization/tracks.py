"""Images of tracks: points drawn with their trails over a rendered film."""

import colorsys
from collections.abc import Iterator, Sequence
from itertools import groupby

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from dnerf.core.cameras import Camera
from dnerf.core.checks import check_positive, check_shape
from dnerf.core.compositing import median_depth
from dnerf.motion import Tracks, follow, motion_model
from dnerf.motion.vectors import inside_image, nearest_value
from dnerf.rendering.renderer import Renderer
from dnerf.visualization.video import to_uint8

WIDTH = 1.5  # of trails, in pixels
SUPERSAMPLING = 3  # Trails are drawn so much larger and scaled down, since Pillow's lines have no smooth edges


@torch.no_grad()
def visible_points(renderer: Renderer, camera: Camera, time: float, spacing: int, *, chunk: int = 16384) -> Tensor:
    """Points (P, 3) on the surfaces that every `spacing`-th pixel of every `spacing`-th row shows.

    The renderer is in evaluation mode. Raises ValueError if the image shows no surface there.
    """
    check_positive("spacing", spacing)
    check_positive("chunk", chunk)
    width, height = camera.intrinsics.width, camera.intrinsics.height
    rows, columns = (torch.arange(min(spacing, size) // 2, size, spacing) for size in (height, width))
    pixels = (width * rows[:, None] + columns).reshape(-1).to(camera.pose.device)
    found = [camera.pose.new_zeros(0, 3)]
    for part in pixels.split(chunk):
        rays = camera.rays(time, part)
        rendering = renderer(rays)
        points = torch.addcmul(rays.origins, median_depth(rendering)[:, None], rays.directions)
        found.append(points[rendering.opacity > 0.9])
    chosen = torch.cat(found)
    if not len(chosen):
        raise ValueError(
            f"time {time}: the image shows no surface at a spacing of {spacing} pixels; take a smaller one"
        )
    return chosen


def draw_tracks(image: Tensor, pixels: Tensor, visible: Tensor, colors: Sequence[tuple[int, int, int]]) -> Tensor:
    """Draw points with their trails, 1.5 pixels wide: (H, W, 3) uint8.

    Args:
        image: (H, W, 3) float in [0, 1] or uint8.
        pixels: (T, P, 2) columns and rows of P points at T >= 1 times, the last one now; whole numbers are pixel
            centres, and trails are drawn where two in a row are finite.
        visible: (P,) bool, whether a point is visible now; the others are left out.
        colors: P colours, 0 to 255.
    """
    check_shape("pixels", pixels, ("T", "P", 2))
    if not len(pixels):
        raise ValueError("pixels must be of one time at least, got none")
    check_shape("visible", visible, (pixels.shape[1],))
    if len(colors) != pixels.shape[1]:
        raise ValueError(f"colors must be {pixels.shape[1]}, one per point, got {len(colors)}")
    drawn = Image.fromarray(to_uint8(image).cpu().numpy())
    size = drawn.size
    drawn = drawn.resize((size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(drawn)
    line, radius = max(1, round(WIDTH * SUPERSAMPLING)), 1.2 * WIDTH * SUPERSAMPLING
    trails = ((pixels.cpu().double() + 0.5) * SUPERSAMPLING).transpose(0, 1)
    for trail, is_visible, color in zip(trails.tolist(), visible.tolist(), colors):
        if not is_visible or not np.isfinite(trail[-1]).all():
            continue
        for is_known, places in groupby(trail, key=lambda place: bool(np.isfinite(place).all())):
            if is_known:
                draw.line([(x, y) for x, y in places], fill=color, width=line, joint="curve")
        x, y = trail[-1]
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color)
    return torch.from_numpy(np.array(drawn.resize(size, Image.Resampling.LANCZOS)))


def track_colors(points: Tensor) -> list[tuple[int, int, int]]:
    """A colour for each of P points (P, 3), its hue by height and its lightness by side."""
    if not len(points):
        return []
    low, high = points.amin(0), points.amax(0)
    unit = ((points - low) / (high - low).clamp(min=1e-6)).tolist()
    return [
        tuple(round(255 * channel) for channel in colorsys.hls_to_rgb(0.83 * z, 0.35 + 0.3 * x, 0.9))  # type: ignore[misc]
        for x, _, z in unit
    ]


def render_tracks(
    renderer: Renderer, camera: Camera, points: Tensor, time: float, times: Sequence[float], *, trail: int = 12,
    every: int = 1, tolerance: float = 0.08, chunk: int = 16384,
) -> tuple[Tracks, Iterator[Tensor]]:  # fmt: skip
    """Follow points and draw them over images (H, W, 3) uint8 of a film, each rendered when it is taken.

    Args:
        renderer: the model; ValueError if its motion is unknown, see `motion_model`.
        camera: the view, on the model's device.
        points: (P, 3) in world units, at `time`.
        time: in [0, 1].
        times: of the film, each in [0, 1].
        trail: earlier times of the film that a trail reaches back.
        every: one image is drawn of so many times, the last one among them.
        tolerance: distance behind the image's surface at which a point counts as hidden, in world units.
    """
    check_positive("every", every)
    model = motion_model(renderer)
    if model is None:
        raise ValueError("renderer must have a motion that is known: a deformation, or a static field")
    tracks = follow(model, points, time, torch.tensor(list(times), dtype=points.dtype, device=points.device))
    pixels, depths = camera.project(tracks.positions)
    pixels = torch.where(depths[..., None] > 0, pixels, torch.nan)  # behind the camera is no place in the image
    colors = track_colors(points)

    def images() -> Iterator[Tensor]:
        for i in range((len(times) - 1) % every, len(times), every):
            rendering = renderer.render_image(camera, float(times[i]), chunk=chunk)
            distance = (tracks.positions[i] - camera.pose[:3, 3]).norm(dim=-1)
            in_front = distance < nearest_value(rendering.depth, pixels[i]) + tolerance
            visible = inside_image(pixels[i], camera) & in_front
            yield draw_tracks(rendering.rgb, pixels[max(0, i - trail) : i + 1], visible, colors)

    return tracks, images()
