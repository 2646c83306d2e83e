"""The views of a film: one camera and one time per frame, and the digest that says which film it is."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics
from dnerf.core.checks import check_shape


@dataclass(frozen=True, eq=False)
class View:
    """One frame of a film; ValueError for a time outside [0, 1]."""

    camera: Camera  # of the frame
    time: float  # in [0, 1]
    truth_index: int | None = None  # index of the data's image with this camera and time, or None

    def __post_init__(self) -> None:
        if not 0 <= self.time <= 1:
            raise ValueError(f"time must be in [0, 1], got {self.time}")

    def as_dict(self) -> dict[str, object]:
        """Plain values, ready for JSON: pose, intrinsics in pixels, planes and time."""
        return {
            "time": self.time, "pose": self.camera.pose.tolist(), "near": self.camera.near, "far": self.camera.far,
            "intrinsics": asdict(self.camera.intrinsics), "truth_index": self.truth_index,
        }  # fmt: skip


def make_views(
    poses: Tensor, times: Sequence[float], intrinsics: Intrinsics | Sequence[Intrinsics],
    planes: Sequence[tuple[float, float]], *, have_truth: bool = False,
) -> list[View]:  # fmt: skip
    """Views of a path.

    Args:
        poses: (F, 4, 4) camera-to-world.
        times: F times in [0, 1]; ValueError if numbers of poses, times, intrinsics or planes differ.
        intrinsics: of all frames, or F of them.
        planes: F z-depths (near, far) where rays begin and end, see `box_planes`.
        have_truth: whether frame i is image i of the data.
    """
    check_shape("poses", poses, (len(times), 4, 4))
    lenses = [intrinsics] * len(times) if isinstance(intrinsics, Intrinsics) else list(intrinsics)
    for name, values in (("planes", planes), ("intrinsics", lenses)):
        if len(values) != len(times):
            raise ValueError(f"{name} must be {len(times)}, got {len(values)}")
    return [
        View(Camera(lens, pose, near, far), float(time), i if have_truth else None)
        for i, (pose, time, lens, (near, far)) in enumerate(zip(poses, times, lenses, planes))
    ]


def sequence_digest(views: Sequence[View], facts: Mapping[str, object]) -> str:
    """Sixteen hexadecimal digits that name a film: other views or other facts give another name.

    Facts are whatever else the frames depend on (the model's weights, the outputs), as plain values.
    """
    text = json.dumps({"views": [view.as_dict() for view in views], "facts": dict(facts)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
