"""Camera paths of nerfstudio's viewer, `camera_path.json`: pose, field of view and perhaps a time of each frame."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dnerf.core.cameras import Intrinsics

MAX_BYTES = 64 * 2**20
MAX_FRAMES = 100_000


@dataclass(frozen=True, eq=False)
class NerfstudioPath:
    """A film's cameras, in the units that the path was made in."""

    poses: Tensor  # (F, 4, 4) float64 camera to world, OpenGL axes
    angles: tuple[float, ...]  # F vertical fields of view in radians
    times: tuple[float, ...] | None  # F in [0, 1]; None if the file says none
    aspect: float  # width over height

    def intrinsics(self, width: int, height: int) -> list[Intrinsics]:
        """The pinhole of every frame, at a size in pixels."""
        focals = [0.5 * height / math.tan(0.5 * angle) for angle in self.angles]
        return [Intrinsics(width, height, focal, focal) for focal in focals]


def read_nerfstudio_path(path: str | Path, transforms: str | Path | None = None) -> NerfstudioPath:
    """Read a camera path.

    nerfstudio's viewer works in the units of its own normalisation. `dataparser_transforms.json`, which it writes
    beside a run, says what they are: with it poses are undone to the data set's own units.

    Args:
        path: the camera path's file.
        transforms: that other file; None if the path is in the data set's units already.

    Raises:
        ValueError: naming the file and the entry that is wrong.
    """
    content = _read(Path(path))
    frames = content.get("camera_path")
    if content.get("camera_type", "perspective") != "perspective":
        raise ValueError(f"{path}: camera_type must be perspective, got {content['camera_type']!r}")
    if not isinstance(frames, list) or not 0 < len(frames) <= MAX_FRAMES:
        raise ValueError(f"{path}: camera_path must be a list of 1 to {MAX_FRAMES} frames")
    poses, angles, times = [], [], []
    for index, frame in enumerate(frames):
        where = f"{path}: camera_path[{index}]"
        if not isinstance(frame, dict):
            raise ValueError(f"{where} must be an object, got {type(frame).__name__}")
        entries = _numbers(frame.get("camera_to_world"), f"{where}.camera_to_world", 16)
        poses.append(torch.tensor(entries, dtype=torch.float64).view(4, 4))
        angle = _numbers([frame.get("fov")], f"{where}.fov", 1)[0]
        if not 0 < angle < 180:
            raise ValueError(f"{where}.fov must be in (0, 180) degrees, got {angle}")
        angles.append(math.radians(angle))
        times.append(frame.get("render_time"))
    timed = None if all(time is None for time in times) else tuple(_numbers(times, f"{path}: render_time", len(times)))
    if timed is not None and not all(0 <= time <= 1 for time in timed):
        raise ValueError(f"{path}: render_time must be in [0, 1], got {min(timed)} to {max(timed)}")
    width, height = (_numbers([content.get(f"render_{side}", 1)], f"{path}: render_{side}", 1)[0] for side in SIDES)
    if not (width > 0 and height > 0):
        raise ValueError(f"{path}: render_width and render_height must be positive, got {width} and {height}")
    stacked = _rigid(torch.stack(poses), path)
    if transforms is not None:
        stacked = _undone(stacked, Path(transforms))
    return NerfstudioPath(stacked, tuple(angles), timed, width / height)


SIDES = ("width", "height")


def _undone(poses: Tensor, path: Path) -> Tensor:
    """Poses before nerfstudio's `pose -> scale * (transform @ pose)`, where the scale acts on positions alone."""
    content = _read(path)
    rows = content.get("transform")
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise ValueError(f"{path}: transform must be 3 rows of 4 numbers")
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3] = torch.tensor([_numbers(row, f"{path}: transform", 4) for row in rows[:3]], dtype=torch.float64)
    scale = _numbers([content.get("scale")], f"{path}: scale", 1)[0]
    if not scale > 0 or abs(float(torch.linalg.det(transform))) < 1e-6:
        raise ValueError(f"{path}: transform must be invertible and scale positive, got scale {scale}")
    unscaled = poses.clone()
    unscaled[:, :3, 3] /= scale
    return _rigid(torch.linalg.inv(transform) @ unscaled, path)


def _rigid(poses: Tensor, path: str | Path) -> Tensor:
    """Poses whose rotations are made exact; ValueError if they are none."""
    if not bool(poses.isfinite().all()):  # the decomposition would raise another error
        raise ValueError(f"{path}: cameras must be at finite places; correct scale and transform")
    left, sizes, right = torch.linalg.svd(poses[:, :3, :3])
    if bool(((sizes - 1).abs() > 1e-2).any()):
        raise ValueError(f"{path}: cameras must be rotated and moved, not scaled")
    result = poses.clone()
    result[:, :3, :3] = left @ right
    result[:, 3] = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
    if bool((torch.linalg.det(result[:, :3, :3]) < 0).any()):
        raise ValueError(f"{path}: cameras must not be mirrored")
    return result


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES // 2**20} MiB")
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a readable JSON file ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: must hold an object, got {type(content).__name__}")
    return content


def _numbers(values: Any, where: str, count: int) -> list[float]:
    is_list = isinstance(values, list) and len(values) == count
    if not is_list or not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) <= 1e9 for x in values):
        raise ValueError(f"{where} must be {count} finite number{'s' * (count > 1)}, got {str(values)[:80]}")
    return [float(x) for x in values]
