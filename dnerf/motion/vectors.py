"""Motion vectors: where the surface that each pixel shows is at another time."""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.cameras import Camera
from dnerf.core.checks import check_positive, check_shape
from dnerf.core.compositing import Rendering
from dnerf.motion.transport import MotionModel, carry, motion_model
from dnerf.rendering.renderer import Renderer

MAX_RESIDUAL = 0.05  # Distance in canonical space, in world units, above which a motion counts as not found
OPAQUE = 0.5  # opacity from which a pixel shows a surface
TOLERANCE = 0.05  # distance behind the other image's surface, in world units, at which a point counts as hidden


@dataclass(frozen=True)
class MotionVectors:
    """Where the surface that each pixel of an image shows is at another time (and in another camera, if given)."""

    flow_2d: Tensor  # (H, W, 2) in pixels, columns to the right and rows down; NaN where not `valid`
    flow_3d: Tensor  # (H, W, 3) in world units; NaN where not `valid`
    positions: Tensor  # (H, W, 3) the points that the pixels show, at the expected depth
    valid: Tensor  # (H, W) bool, opaque pixels of a known motion, whose surface is in front of the other camera
    visible: Tensor  # (H, W) bool, valid pixels whose surface is inside the other image, not known to be hidden there
    residual: Tensor  # (H, W) see `carry`; NaN where not `valid`

    @property
    def found(self) -> Tensor:
        """(H, W) bool, valid pixels whose motion an inverse has found, see `MAX_RESIDUAL`."""
        return self.valid & (self.residual <= MAX_RESIDUAL)


@torch.no_grad()
def motion_vectors(
    model: MotionModel | None, camera: Camera, time: float, other_time: float, depth: Tensor, opacity: Tensor, *,
    other_camera: Camera | None = None, other_depth: Tensor | None = None, chunk: int = 65536,
) -> MotionVectors:  # fmt: skip
    """Motion of every pixel of an image between two times.

    Args:
        model: see `motion_model`; with None, an unknown motion, no pixel is valid.
        time: of the image, in [0, 1].
        other_time: where to, in [0, 1].
        depth: (H, W) expected distance along the rays, as in `Rendering.depth`; ValueError for another shape.
        opacity: (H, W).
        other_camera: of the other image; the same camera if None, and 2-D motion is that of the scene alone.
        other_depth: (H, W) depth of the other image, to find what is hidden there; None takes nothing as hidden.
    """
    size = (camera.intrinsics.height, camera.intrinsics.width)
    check_shape("depth", depth, size)
    check_shape("opacity", opacity, size)
    check_positive("chunk", chunk)
    other_camera = camera if other_camera is None else other_camera
    rays = camera.rays(time)
    positions = torch.addcmul(rays.origins, depth.reshape(-1, 1), rays.directions)
    moved, residual = torch.full_like(positions, torch.nan), torch.full_like(positions[:, 0], torch.nan)
    if model is not None:
        for some in (opacity.reshape(-1) >= OPAQUE).nonzero()[:, 0].split(chunk):
            moved[some], residual[some] = carry(model, positions[some], time, other_time)
    pixels, other_z = other_camera.project(moved)
    valid = other_z > 0
    visible = valid & inside_image(pixels, other_camera)
    if other_depth is not None:
        check_shape("other_depth", other_depth, (other_camera.intrinsics.height, other_camera.intrinsics.width))
        distance = (moved - other_camera.pose[:3, 3]).norm(dim=-1)
        visible &= distance <= nearest_value(other_depth, pixels) + TOLERANCE
    flow_2d = torch.where(valid[:, None], pixels - camera.project(positions)[0], torch.nan)
    flow_3d = torch.where(valid[:, None], moved - positions, torch.nan)
    residual = torch.where(valid, residual, torch.nan)
    found = (flow_2d, flow_3d, positions, valid, visible, residual)
    return MotionVectors(*(values.reshape(*size, *values.shape[1:]) for values in found))


def render_motion(
    renderer: Renderer, camera: Camera, time: float, other_time: float, *, chunk: int = 16384
) -> tuple[Rendering, Rendering, MotionVectors]:
    """Render an image at two times in [0, 1], and the motion of the first one's pixels to the second.

    What is hidden in the second image is left out of the motion's `visible`.
    """
    first, second = (renderer.render_image(camera, t, chunk=chunk) for t in (time, other_time))
    vectors = motion_vectors(
        motion_model(renderer), camera, time, other_time, first.depth, first.opacity,
        other_depth=hiding_depth(second.depth, second.opacity), chunk=chunk,
    )  # fmt: skip
    return first, second, vectors


def hiding_depth(depth: Tensor, opacity: Tensor) -> Tensor:
    """Depth of an image, infinite where it is transparent: rays that meet nothing have depth 0, but hide nothing."""
    return torch.where(opacity < OPAQUE, torch.inf, depth)


def inside_image(pixels: Tensor, camera: Camera) -> Tensor:
    """Whether points (N, 2) round to a pixel of the image; NaN does not."""
    limits = torch.tensor([camera.intrinsics.width, camera.intrinsics.height], device=pixels.device)
    return ((pixels >= -0.5) & (pixels < limits - 0.5)).all(-1)


def nearest_value(image: Tensor, pixels: Tensor) -> Tensor:
    """Value (N,) of the pixel nearest to each of (N, 2), those outside clamped to the edge."""
    pixels = pixels.nan_to_num(nan=0.0)
    columns = pixels[:, 0].round().clamp(0, image.shape[1] - 1).long()
    rows = pixels[:, 1].round().clamp(0, image.shape[0] - 1).long()
    return image[rows, columns]
