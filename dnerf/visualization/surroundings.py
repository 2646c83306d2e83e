"""Where the training cameras stand around the scene: what films take their centre, distance and angles from."""

import math
from collections import Counter
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dnerf.core.cameras import Camera, Intrinsics
from dnerf.data.scene_record import CameraSet
from dnerf.data.viewpoints import Viewpoints, common_focus, depths_of

ALL_AROUND = math.radians(120.0)  # largest gap between azimuths of cameras that stand all around
STEEPEST = math.radians(80.0)
ENDS = (0.1, 0.9)  # of elevations: what a spiral rises between
IN_VIEW = 0.5  # share of cameras that see the box's middle, for it to be what films look at


@dataclass(frozen=True)
class Surroundings:
    """Training cameras in terms of a point that they look at; world units and radians, z up."""

    target: tuple[float, float, float]
    radius: float  # median distance of the cameras
    elevation: float  # median
    elevations: tuple[float, float]  # what most lie between
    azimuth: float  # where the widest arc of cameras begins
    arc: float  # how far it goes; 2 pi if they stand all around
    intrinsics: Intrinsics  # the most frequent, without the lens's distortion

    @classmethod
    def of(cls, cameras: CameraSet) -> "Surroundings":
        """Those of the training cameras."""
        views = Viewpoints.of(cameras.poses, cameras.intrinsics)
        target = _target(cameras, views)
        offsets = views.positions - target
        distances = offsets.norm(dim=-1)
        rises = torch.asin((offsets[:, 2] / distances.clamp(min=1e-9)).clamp(-1, 1)).clamp(-STEEPEST, STEEPEST)
        low, high = torch.quantile(rises, torch.tensor(ENDS, dtype=rises.dtype)).tolist()
        azimuth, arc = _widest_arc(torch.atan2(offsets[:, 1], offsets[:, 0]))
        x, y, z = target.tolist()
        most_frequent = Counter(cameras.intrinsics).most_common(1)[0][0]
        return cls(
            (x, y, z), max(float(distances.median()), 1e-6), float(rises.median()), (low, high), azimuth, arc,
            replace(most_frequent, distortion=None),
        )  # fmt: skip

    def sway(self) -> tuple[float, float] | None:
        """The middle azimuth of the cameras and how far they go to either side; None if they stand all around."""
        return None if self.arc >= 2 * math.pi else (self.azimuth + 0.5 * self.arc, 0.5 * self.arc)


def _target(cameras: CameraSet, views: Viewpoints) -> Tensor:
    """The middle of the box, which is the origin, if enough cameras see it; else what they look at."""
    middle = torch.zeros(3, dtype=torch.float64)
    seen = 0
    for pose, lens in zip(cameras.poses, cameras.intrinsics):
        pixel, depth = Camera(lens, pose).project(middle.float())
        x, y = pixel.tolist()
        seen += float(depth) > 0 and -0.5 <= x <= lens.width - 0.5 and -0.5 <= y <= lens.height - 0.5
    if seen >= IN_VIEW * len(cameras):
        return middle
    focus = common_focus(views)
    if focus is not None:
        return focus
    ahead = float(depths_of(views, middle).abs().median())
    return views.positions.mean(0) + ahead * torch.nn.functional.normalize(views.forward.mean(0), dim=0)


def _widest_arc(azimuths: Tensor) -> tuple[float, float]:
    """Where the arc outside of the largest gap between angles begins, and how long it is; 2 pi if no gap is wide."""
    angles = azimuths.sort().values
    gaps = torch.cat([angles[1:] - angles[:-1], (angles[0] + 2 * math.pi - angles[-1])[None]])
    widest = int(gaps.argmax())
    if float(gaps[widest]) <= ALL_AROUND:
        return 0.0, 2 * math.pi
    return float(angles[(widest + 1) % len(angles)]), 2 * math.pi - float(gaps[widest])
