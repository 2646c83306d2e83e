"""Pinhole cameras, their rays, and camera paths. Poses are camera-to-world with OpenGL axes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dnerf.checks import check_choice, check_positive, check_shape
from dnerf.geometry import check_last_axis
from dnerf.rays import Rays

PIXEL_OFFSETS = {"center": 0.5, "corner": 0.0}


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without a pose.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        focal_x: focal length in pixels along x.
        focal_y: focal length in pixels along y.
        center_x: principal point in pixels, from the left edge; the image's middle if None.
        center_y: the same from the top edge.
        pixel_origin: "center" casts rays through pixel centres (+0.5); "corner" through their upper left corners,
            as D-NeRF's code does.

    Raises:
        ValueError: for sizes or focal lengths that are not positive, or an unknown pixel origin.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    center_x: float | None = None
    center_y: float | None = None
    pixel_origin: str = "center"

    def __post_init__(self) -> None:
        for name in ("width", "height", "focal_x", "focal_y"):
            check_positive(name, getattr(self, name))
        check_choice("pixel_origin", self.pixel_origin, tuple(PIXEL_OFFSETS))

    @classmethod
    def from_angle(cls, width: int, height: int, angle_x: float, pixel_origin: str = "center") -> "Intrinsics":
        """Camera with square pixels and the given horizontal field of view in radians, in (0, pi).

        Raises:
            ValueError: for an angle outside (0, pi).
        """
        if not 0 < angle_x < math.pi:
            raise ValueError(f"angle_x must be in (0, pi) radians, got {angle_x}")
        focal = 0.5 * width / math.tan(0.5 * angle_x)
        return cls(width, height, focal, focal, pixel_origin=pixel_origin)

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The same view with another number of pixels."""
        scale_x, scale_y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            focal_x=self.focal_x * scale_x,
            focal_y=self.focal_y * scale_y,
            center_x=None if self.center_x is None else self.center_x * scale_x,
            center_y=None if self.center_y is None else self.center_y * scale_y,
        )

    @property
    def lens(self) -> tuple[float, float, float, float]:
        """Focal lengths along x and y, principal column and row; the rays of pixels go through whole numbers."""
        offset = PIXEL_OFFSETS[self.pixel_origin]
        center_x = 0.5 * self.width if self.center_x is None else self.center_x
        center_y = 0.5 * self.height if self.center_y is None else self.center_y
        return self.focal_x, self.focal_y, center_x - offset, center_y - offset

    def pixel_directions(self, columns: Tensor, rows: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
        """Directions in camera space with z = -1: (...,) integer pixels -> (..., 3)."""
        focal_x, focal_y, column, row = self.lens
        x = (columns.to(dtype) - column) / focal_x
        y = (row - rows.to(dtype)) / focal_y
        return torch.stack([x, y, -torch.ones_like(x)], dim=-1)


def camera_rays(
    intrinsics: Intrinsics,
    poses: Tensor,
    columns: Tensor,
    rows: Tensor,
    *,
    times: Tensor,
    near: float,
    far: float,
) -> Rays:
    """Rays through pixels, each of its own camera and time.

    Args:
        intrinsics: shared by all.
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
    """A pinhole camera with a pose and clipping planes.

    Args:
        intrinsics: image size and focal lengths.
        pose: (4, 4) camera-to-world, OpenGL axes.
        near: z-depth where rays begin, in world units.
        far: z-depth where rays end.

    Raises:
        ValueError: for a pose of another shape or planes not 0 <= near < far.
    """

    intrinsics: Intrinsics
    pose: Tensor
    near: float = 2.0
    far: float = 6.0

    def __post_init__(self) -> None:
        check_shape("pose", self.pose, (4, 4))
        if not 0 <= self.near < self.far < math.inf:
            raise ValueError(f"near and far must be finite with 0 <= near < far, got {self.near} and {self.far}")

    def project(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Where world positions (..., 3) are seen.

        Returns:
            pixels: (..., 2) column and row; whole numbers are where the rays of pixels go. Not finite in the plane of
                the camera, mirrored behind it.
            depth: (...,) z-depth in world units, negative behind the camera.
        """
        check_last_axis("positions", positions, 3)
        pose = self.pose.to(positions.dtype)
        offsets = (positions - pose[:3, 3]).unbind(-1)
        x, y, z = (_product(offsets, pose[:3, axis]) for axis in range(3))
        depth = -z
        focal_x, focal_y, column, row = self.intrinsics.lens
        return torch.stack([x / depth * focal_x + column, row - y / depth * focal_y], dim=-1), depth

    def rays(self, time: float, pixels: Tensor | None = None) -> Rays:
        """Rays of pixels at one time.

        Args:
            time: in [0, 1].
            pixels: (P,) int64, `row * width + column`; None for all height * width of them, in this order.
        """
        if pixels is None:
            pixels = torch.arange(self.intrinsics.width * self.intrinsics.height, device=self.pose.device)
        return camera_rays(
            self.intrinsics,
            self.pose,
            pixels % self.intrinsics.width,
            pixels // self.intrinsics.width,
            times=torch.full((len(pixels),), time, dtype=self.pose.dtype, device=self.pose.device),
            near=self.near,
            far=self.far,
        )


def _product(left: Sequence[Tensor] | Tensor, right: Sequence[Tensor] | Tensor) -> Tensor:
    """The scalar product of vectors given as three columns each.

    Not a matrix product, which GPUs may run in tf32, nor a sum over an axis of three, which takes several times longer.
    """
    return left[0] * right[0] + left[1] * right[1] + left[2] * right[2]


def look_at(
    eye: Sequence[float], target: Sequence[float] = (0.0, 0.0, 0.0), up: Sequence[float] = (0.0, 0.0, 1.0)
) -> Tensor:
    """Pose (4, 4) of a camera at `eye` that looks at `target`.

    Raises:
        ValueError: if eye and target coincide or the view is parallel to `up`.
    """
    position = torch.tensor(eye, dtype=torch.float64)
    backward = position - torch.tensor(target, dtype=torch.float64)
    right = torch.linalg.cross(torch.tensor(up, dtype=torch.float64), backward)
    if not bool(right.norm() > 1e-9 * backward.norm()):
        raise ValueError(f"eye must differ from target and not lie along up, got {list(eye)} and {list(target)}")
    backward, right = backward / backward.norm(), right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3] = torch.stack([right, torch.linalg.cross(backward, right), backward, position], dim=1)
    return pose.float()


def orbit_path(
    num_poses: int,
    *,
    radius: float = 4.0,
    elevation: float = math.radians(30),
    target: Sequence[float] = (0.0, 0.0, 0.0),
    turns: float = 1.0,
    start_angle: float = 0.0,
) -> Tensor:
    """Poses (num_poses, 4, 4) on a circle of latitude around `target`, z up, angles in radians.

    A whole number of turns closes: the pose after the last is the first.
    """
    return spiral_path(
        num_poses, radius=radius, elevations=(elevation, elevation), target=target, turns=turns,
        start_angle=start_angle,
    )  # fmt: skip


def spiral_path(
    num_poses: int,
    *,
    radius: float = 4.0,
    elevations: tuple[float, float] = (math.radians(5), math.radians(60)),
    target: Sequence[float] = (0.0, 0.0, 0.0),
    turns: float = 2.0,
    start_angle: float = 0.0,
) -> Tensor:
    """Poses (num_poses, 4, 4) circling `target` while rising from one elevation to the other and back.

    Raises:
        ValueError: if the number or the radius is not positive.
    """
    check_positive("num_poses", num_poses)
    check_positive("radius", radius)
    poses = []
    for i in range(num_poses):
        phase = 2 * math.pi * i / num_poses
        angle = start_angle + turns * phase
        rise = 0.5 * (1 - math.cos(phase))
        elevation = elevations[0] + rise * (elevations[1] - elevations[0])
        offset = (
            math.cos(elevation) * math.cos(angle), math.cos(elevation) * math.sin(angle), math.sin(elevation)
        )  # fmt: skip
        poses.append(look_at([t + radius * o for t, o in zip(target, offset)], target))
    return torch.stack(poses)


def fixed_path(num_poses: int, pose: Tensor) -> Tensor:
    """The same pose, (num_poses, 4, 4)."""
    check_positive("num_poses", num_poses)
    check_shape("pose", pose, (4, 4))
    return pose.expand(num_poses, 4, 4)
