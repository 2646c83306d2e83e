"""Camera paths: the pose of every frame of a film, and its planes."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dnerf.core.cameras import look_at
from dnerf.core.checks import check_positive, check_shape


def pose_around(target: Sequence[float], *, radius: float, azimuth: float, elevation: float) -> Tensor:
    """Pose (4, 4) of a camera at a distance from `target` that looks at it, z up, angles in radians.

    Raises ValueError if the radius is not positive or the camera looks straight up or down.
    """
    check_positive("radius", radius)
    around = math.cos(elevation)
    offset = (around * math.cos(azimuth), around * math.sin(azimuth), math.sin(elevation))
    return look_at([t + radius * o for t, o in zip(target, offset, strict=True)], target)


def spiral_path(
    num_poses: int, *, radius: float = 4.0, elevations: tuple[float, float] = (math.radians(5), math.radians(60)),
    target: Sequence[float] = (0.0, 0.0, 0.0), turns: float = 2.0, start_angle: float = 0.0, sway: float | None = None,
) -> Tensor:  # fmt: skip
    """Poses (num_poses, 4, 4) circling `target` while rising from one elevation to the other and back.

    With `sway`, an angle, the path does not go round but so far to either side of `start_angle`, `turns` times.
    """
    check_positive("num_poses", num_poses)
    poses = []
    for i in range(num_poses):
        phase = 2 * math.pi * i / num_poses
        rise = 0.5 * (1 - math.cos(phase))
        elevation = elevations[0] + rise * (elevations[1] - elevations[0])
        azimuth = start_angle + (turns * phase if sway is None else sway * math.sin(turns * phase))
        poses.append(pose_around(target, radius=radius, azimuth=azimuth, elevation=elevation))
    return torch.stack(poses)


def fixed_path(num_poses: int, pose: Tensor) -> Tensor:
    """The same pose, (num_poses, 4, 4)."""
    check_positive("num_poses", num_poses)
    check_shape("pose", pose, (4, 4))
    return pose.expand(num_poses, 4, 4)
