"""Cameras and their rays. Poses are camera-to-world with OpenGL axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_positive, check_shape
from dnerf.core.geometry import check_last_axis
from dnerf.core.lenses import Distortion, Region, examine, project_beyond, undistort
from dnerf.core.rays import Rays

PIXEL_OFFSETS = {"center": 0.5, "corner": 0.0}


@dataclass(frozen=True)
class Intrinsics:
    """A camera without a pose, all lengths in pixels.

    Rays go through pixel centres (+0.5); through their upper left corners, as in D-NeRF's code, with "corner".

    Raises:
        ValueError: for sizes or focal lengths that are not positive, a principal point that is not finite, an unknown
            pixel origin, or a lens that folds over inside the image, see `examine`.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float | None = None  # principal point, from the left edge; the image's middle if None
    center_y: float | None = None  # the same from the top edge
    pixel_origin: str = "center"  # or "corner"
    distortion: Distortion | None = None  # of the lens; None for a pinhole

    def __post_init__(self) -> None:
        for name in ("width", "height", "focal_x", "focal_y"):
            check_positive(name, getattr(self, name))
        check_choice("pixel_origin", self.pixel_origin, tuple(PIXEL_OFFSETS))
        for name in ("center_x", "center_y"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} must be finite or None, got {value}")
        if self.distortion is not None:
            self.region()

    @classmethod
    def from_angle(cls, width: int, height: int, angle_x: float, pixel_origin: str = "center") -> "Intrinsics":
        """Camera with square pixels and the given horizontal field of view in radians; ValueError outside (0, pi)."""
        if not 0 < angle_x < math.pi:
            raise ValueError(f"angle_x must be in (0, pi) radians, got {angle_x}")
        focal = 0.5 * width / math.tan(0.5 * angle_x)
        return cls(width, height, focal, focal, pixel_origin=pixel_origin)

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The same view with another number of pixels."""
        scale_x, scale_y = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, focal_x=self.focal_x * scale_x, focal_y=self.focal_y * scale_y,
            center_x=None if self.center_x is None else self.center_x * scale_x,
            center_y=None if self.center_y is None else self.center_y * scale_y,
        )  # fmt: skip

    @property
    def center(self) -> tuple[float, float]:
        """The principal point, from the left and from the top edge."""
        return (
            0.5 * self.width if self.center_x is None else self.center_x,
            0.5 * self.height if self.center_y is None else self.center_y,
        )

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Focal lengths along x and y, principal column and row; the rays of pixels go through whole numbers."""
        offset = PIXEL_OFFSETS[self.pixel_origin]
        center_x, center_y = self.center
        return self.focal_x, self.focal_y, center_x - offset, center_y - offset

    def region(self) -> Region:
        """What is known of the distortion inside the image; there must be one."""
        assert self.distortion is not None
        center_x, center_y = self.center
        return examine(
            self.distortion, -center_x / self.focal_x, (self.width - center_x) / self.focal_x,
            -center_y / self.focal_y, (self.height - center_y) / self.focal_y,
        )  # fmt: skip

    def pixel_directions(self, columns: Tensor, rows: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Directions in camera space with z = -1: (...,) columns and rows, whole for pixels -> (..., 3)."""
        focal_x, focal_y, column, row = self.pinhole
        if self.distortion is not None:
            x, y = (columns.double() - column) / focal_x, (rows.double() - row) / focal_y
            x, y = undistort(self.distortion.model, self.distortion.coefficients, x, y, self.region())
            return torch.stack([x, -y, -torch.ones_like(x)], dim=-1).to(dtype)
        x = (columns.to(dtype) - column) / focal_x
        y = (row - rows.to(dtype)) / focal_y
        return torch.stack([x, y, -torch.ones_like(x)], dim=-1)

    def seen_at(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Column and row (...) where positions in the plane at depth 1, x right and y up, are seen."""
        focal_x, focal_y, column, row = self.pinhole
        if self.distortion is not None:
            model, coefficients = self.distortion.model, self.distortion.coefficients
            u, v = project_beyond(model, coefficients, self.region().radius, x.double(), -y.double())
            return (u * focal_x + column).to(x.dtype), (v * focal_y + row).to(x.dtype)
        return x * focal_x + column, row - y * focal_y


class PixelDirections(Protocol):
    """What rays need to know of cameras: `Intrinsics`, or those of each ray (`RayIntrinsics`)."""

    def pixel_directions(self, columns: Tensor, rows: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Directions in camera space with z = -1, (R, 3)."""


def camera_rays(
    intrinsics: PixelDirections, poses: Tensor, columns: Tensor, rows: Tensor, *, times: Tensor, near: float, far: float
) -> Rays:
    """Rays through pixels, each of its own camera and time.

    Args:
        intrinsics: shared by all, or those of each.
        poses: (R, 4, 4) or (4, 4), camera-to-world.
        columns: (R,) pixel columns.
        rows: (R,) pixel rows.
        times: (R,) in [0, 1].
        near: z-depth (along the viewing axis) where rays begin, in world units; D-NeRF's files mean this.
        far: z-depth where rays end.

    Returns:
        Rays with unit directions; `near` and `far` are distances, z-depth times the unnormalised direction's length.
    """
    local = intrinsics.pixel_directions(columns, rows, poses.dtype).unbind(-1)
    lengths = _product(local, local).sqrt()
    unit = [x / lengths for x in local]
    directions = torch.stack([_product(poses[..., row, :3].unbind(-1), unit) for row in range(3)], dim=-1)
    origins = poses[..., :3, 3].expand(directions.shape)
    return Rays(origins, directions, times.to(poses.dtype), near * lengths, far * lengths)


@dataclass(frozen=True)
class Camera:
    """A camera with a pose and clipping planes; ValueError for another shape or not 0 <= near < far."""

    intrinsics: Intrinsics
    pose: Tensor  # (4, 4) camera-to-world, OpenGL axes
    near: float = 2.0  # z-depth where rays begin, in world units
    far: float = 6.0  # z-depth where rays end

    def __post_init__(self) -> None:
        check_shape("pose", self.pose, (4, 4))
        if not 0 <= self.near < self.far < math.inf:
            raise ValueError(f"near and far must be finite with 0 <= near < far, got {self.near} and {self.far}")

    def project(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Where world positions (..., 3) are seen.

        Returns:
            pixels: (..., 2) column and row; whole numbers are where the rays of pixels go. Not finite in the plane of
                the camera, mirrored behind it. Beyond what the image holds, distortion goes on straight outwards.
            depth: (...,) z-depth in world units, negative behind the camera.
        """
        check_last_axis("positions", positions, 3)
        pose = self.pose.to(positions.dtype)
        offsets = (positions - pose[:3, 3]).unbind(-1)
        x, y, z = (_product(offsets, pose[:3, axis]) for axis in range(3))
        depth = -z
        return torch.stack(self.intrinsics.seen_at(x / depth, y / depth), dim=-1), depth

    def rays(self, time: float, pixels: Tensor | None = None) -> Rays:
        """Rays at a time in [0, 1] of pixels (P,) int64, `row * width + column`; None for all, in this order."""
        if pixels is None:
            pixels = torch.arange(self.intrinsics.width * self.intrinsics.height, device=self.pose.device)
        return camera_rays(
            self.intrinsics, self.pose, pixels % self.intrinsics.width, pixels // self.intrinsics.width,
            times=torch.full((len(pixels),), time, dtype=self.pose.dtype, device=self.pose.device), near=self.near,
            far=self.far,
        )  # fmt: skip


def _product(left: Sequence[Tensor] | Tensor, right: Sequence[Tensor] | Tensor) -> Tensor:
    """The scalar product of vectors given as three columns each.

    Not a matrix product, which GPUs may run in tf32, nor a sum over an axis of three, which takes several times longer.
    """
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


def look_at(
    eye: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.0), up: Sequence[float] = (0.0, 0.0, 1.0)
) -> Tensor:
    """Pose (4, 4) of a camera at `eye` that looks at `target`; ValueError where they coincide or lie along `up`."""
    position = torch.tensor(eye, dtype=torch.float64)
    backward = position - torch.tensor(target, dtype=torch.float64)
    right = torch.linalg.cross(torch.tensor(up, dtype=torch.float64), backward)
    if not bool(right.norm() > 1e-9 * backward.norm()):
        raise ValueError(f"eye must differ from target and not lie along up, got {list(eye)} and {list(target)}")
    backward, right = backward / backward.norm(), right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack([right, torch.linalg.cross(backward, right), backward, position], dim=1)
    return pose.float()
