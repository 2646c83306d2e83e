"""One image that shows how a data set is understood: cameras, box and planes from above and the side, and in images."""

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from dnerf.core.cameras import Camera
from dnerf.core.geometry import cube_corners
from dnerf.data.frames import Frames
from dnerf.data.scene_record import SceneRecord

SIDE = 480  # pixels of a panel
MARGIN = 24
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]  # of the box's corners, z fastest
BOX, TRAIN, OTHER, PLANES = (200, 40, 40), (30, 90, 200), (150, 150, 150), (120, 190, 120)
PIECES = 24  # of an edge: a lens bends it
NUM_FRUSTUMS = 24  # evenly spread, whose planes are drawn
BEHIND = (0.85, 0.85, 0.85)  # images with alpha


def data_sheet(scene: SceneRecord, frames: Frames) -> Tensor:
    """A sheet (H, W, 3) float32 in [0, 1]: two plans, and the first, middle and last training image with the box.

    Training cameras are blue, others grey, the box is red, near and far are green.

    Args:
        scene: the data set's record.
        frames: its training frames.
    """
    low, high = torch.tensor(scene.world.box)
    corners = torch.lerp(low, high, cube_corners(low.device).float())
    plans = [_plan(scene, frames, corners, axes, name) for axes, name in (((0, 1), "from above"), ((0, 2), "the side"))]
    chosen = sorted({0, len(frames) // 2, len(frames) - 1}, key=lambda index: float(frames.times[index]))
    images = [_with_box(frames, index, corners) for index in chosen]
    sheet = Image.new("RGB", (SIDE * 3, SIDE * 2), "white")
    for row, panels in enumerate((plans, images)):
        for column, panel in enumerate(panels):
            sheet.paste(panel, (column * SIDE, row * SIDE))
    return torch.from_numpy(np.asarray(sheet).copy()).float() / 255


def _plan(scene: SceneRecord, frames: Frames, corners: Tensor, axes: tuple[int, int], name: str) -> Image.Image:
    """Cameras, box and planes along a world axis."""
    panel = Image.new("RGB", (SIDE, SIDE), "white")
    draw = ImageDraw.Draw(panel)
    places = torch.cat([corners, *(cameras.poses[:, :3, 3] for cameras in scene.cameras.values())])[:, list(axes)]
    low, high = places.amin(0), places.amax(0)
    scale = (SIDE - 2 * MARGIN) / float((high - low).max().clamp(min=1e-6))
    middle = 0.5 * (low + high)

    def project(positions: Tensor) -> list[tuple[float, float]]:
        flat = (positions[..., list(axes)] - middle) * scale
        return [(SIDE / 2 + x, SIDE / 2 - y) for x, y in flat.reshape(-1, 2).tolist()]

    step = max(1, len(frames) // NUM_FRUSTUMS)
    for index in range(0, len(frames), step):
        pose = frames.poses[index].cpu()
        ends = torch.stack([pose[:3, 3] - depth * pose[:3, 2] for depth in (frames.near, frames.far)])
        draw.line(project(ends), fill=PLANES)
    for a, b in EDGES:
        draw.line(project(corners[[a, b]]), fill=BOX, width=2)
    for split, cameras in sorted(scene.cameras.items(), key=lambda item: item[0] == "train"):
        color = TRAIN if split == "train" else OTHER
        reach = 14 / scale
        for pose in cameras.poses:
            draw.line(project(torch.stack([pose[:3, 3], pose[:3, 3] - reach * pose[:3, 2]])), fill=color)
            x, y = project(pose[:3, 3])[0]
            draw.ellipse((x - 2.5, y - 2.5, x + 2.5, y + 2.5), fill=color)
    draw.text((6, 4), name, fill="black")
    return panel


def _with_box(frames: Frames, index: int, corners: Tensor) -> Image.Image:
    """A training image with the box's edges, as its camera sees them."""
    pixels = (frames.image(index, BEHIND).cpu() * 255).round().to(torch.uint8).numpy()
    image = Image.fromarray(pixels)
    factor = min(SIDE / image.width, (SIDE - MARGIN) / image.height)
    size = max(1, round(image.width * factor)), max(1, round(image.height * factor))
    panel = Image.new("RGB", (SIDE, SIDE), "white")
    panel.paste(image.resize(size, Image.Resampling.NEAREST if factor > 2 else Image.Resampling.BILINEAR), (0, MARGIN))
    draw = ImageDraw.Draw(panel)
    camera = Camera(frames.intrinsics[index], frames.poses[index].cpu(), frames.near, frames.far)
    share = torch.linspace(0, 1, PIECES + 1)[:, None]
    for a, b in EDGES:
        seen, depth = camera.project(torch.lerp(corners[a], corners[b], share))
        points = [((x + 0.5) * factor, (y + 0.5) * factor + MARGIN) for x, y in seen.tolist()]
        for i in range(PIECES):
            if float(depth[i : i + 2].min()) > 0 and all(abs(x) < 1e5 for point in points[i : i + 2] for x in point):
                draw.line(points[i : i + 2], fill=BOX)
    draw.rectangle((0, 0, SIDE, MARGIN - 1), fill="white")
    name = frames.names[index] if frames.names else f"frame {index}"
    draw.text((6, 4), f"{name}, t = {float(frames.times[index]):.3f}", fill="black")
    return panel
