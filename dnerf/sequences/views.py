"""What a sequence shows: one camera and one time per frame, and the digest that says which sequence it is."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from torch import Tensor

from dnerf.cameras import Camera, Intrinsics
from dnerf.checks import check_shape


@dataclass(frozen=True, eq=False)
class View:
    """One frame of a sequence.

    Args:
        camera: where it is seen from.
        time: in [0, 1].
        truth_index: index of the data's picture with this camera and time, or None.

    Raises:
        ValueError: for a time outside [0, 1].
    """

    camera: Camera
    time: float
    truth_index: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.time <= 1:
            raise ValueError(f"time must be in [0, 1], got {self.time}")

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON: pose, intrinsics in pixels, planes and time."""
        return {
            "time": self.time,
            "pose": self.camera.pose.tolist(),
            "near": self.camera.near,
            "far": self.camera.far,
            "intrinsics": asdict(self.camera.intrinsics),
            "truth_index": self.truth_index,
        }


def make_views(
    poses: Tensor,
    times: Sequence[float],
    intrinsics: Intrinsics,
    near: float,
    far: float,
    *,
    angles: Sequence[float | None] | None = None,
    have_truth: bool = False,
) -> list[View]:
    """Views of a path.

    Args:
        poses: (F, 4, 4) camera-to-world.
        times: F times in [0, 1].
        intrinsics: of all frames.
        near: z-depth where rays begin.
        far: z-depth where they end.
        angles: F horizontal fields of view in radians that replace the intrinsics' own; None keeps it.
        have_truth: whether frame i is picture i of the data.

    Raises:
        ValueError: if numbers of poses, times and angles differ, or a time or angle is out of range.
    """
    check_shape("poses", poses, (len(times), 4, 4))
    if angles is not None and len(angles) != len(times):
        raise ValueError(f"angles must be {len(times)}, got {len(angles)}")
    views = []
    for i, (pose, time) in enumerate(zip(poses, times)):
        angle = None if angles is None else angles[i]
        seen = intrinsics
        if angle is not None:
            seen = Intrinsics.from_angle(intrinsics.width, intrinsics.height, angle, intrinsics.pixel_origin)
        views.append(View(Camera(seen, pose, near, far), float(time), i if have_truth else None))
    return views


def sequence_digest(views: Sequence[View], facts: Mapping[str, object]) -> str:
    """Sixteen hexadecimal digits that name a sequence: other views or other facts give another name.

    Args:
        views: the frames.
        facts: whatever else the frames depend on (the model's weights, the outputs), as plain values.
    """
    text = json.dumps({"views": [view.as_dict() for view in views], "facts": dict(facts)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
