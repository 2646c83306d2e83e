"""Exposure and white balance that differ between cameras or drift through a film, which are not the scene's."""

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_whole
from dnerf.core.geometry import distinct_places
from dnerf.nn.encodings import FramesAware
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup

SAME_PLACE = 0.03  # of the distance of the outermost camera from all cameras' middle
MOST = 16  # cameras of a rig


def rig_places(places: Tensor, most: int = MOST) -> Tensor:
    """Of frames at places (F, 3) those (C, 3) of the cameras that stand still; the first one if there are none."""
    spread = (places - places.mean(0)).norm(dim=-1).max()
    found = distinct_places(places, SAME_PLACE * float(spread), most)
    return found if len(found) <= most and 2 * len(found) <= len(places) else places[:1]


class Exposure(nn.Module, DeclaresGroups, FramesAware):
    """Factors `exp(e(c, t) - mean e)` of red, green and blue, with e learnt at even times and linear between them.

    Each camera c of a rig, from whose place there are several frames, has factors of its own. The frames of a camera
    that moves share them. They begin at 1. Their geometric mean stays 1, since the scene could be brighter instead.

    Source: the affine colours of each image in Urban Radiance Fields (arXiv 2111.14643), here one factor a colour.

    Args:
        num_times: at which factors are learnt; half as many as a camera has frames, if those are fewer.
        most_cameras: that a rig has; more places are those of a camera that moves.

    Raises:
        ValueError: for fewer than two times, or no camera.
    """

    def __init__(self, num_times: int = 32, most_cameras: int = MOST) -> None:
        super().__init__()
        for name, count in (("num_times", num_times), ("most_cameras", most_cameras)):
            check_whole(name, count)
        if num_times < 2:
            raise ValueError(f"num_times must be at least 2, got {num_times}")
        self.logarithms = nn.Parameter(torch.zeros(most_cameras, num_times, 3))
        self.places = nn.Buffer(torch.full((most_cameras, 3), torch.inf))  # of cameras in use, in world units
        self.is_used = nn.Buffer((torch.arange(most_cameras) == 0).float()[:, None, None].repeat(1, num_times, 1))

    def see(self, times: Tensor, places: Tensor) -> None:
        """Find the cameras of a rig, and the times near which each has frames; those that are known stay."""
        if bool(self.places.isfinite().any()):
            return
        found = rig_places(places, len(self.places))
        self.places[: len(found)] = found.to(self.places)
        self.is_used.zero_()[: len(found), : max(len(places) // (2 * len(found)), 2)] = 1

    def forward(self, rgb: Tensor, origins: Tensor, times: Tensor) -> Tensor:
        """What cameras at origins (R, 3) show of colours (R, 3) at times (R,) in [0, 1]."""
        cameras = (origins[:, None] - self.places).square().sum(-1).argmin(1)
        centered = self.logarithms - (self.is_used * self.logarithms).sum((0, 1)) / self.is_used.sum()
        last = self.is_used[0].sum().to(times) - 1
        before = torch.minimum((times.detach() * last).clamp(min=0), last - 1).long()
        share = (times * last - before)[:, None]
        return rgb * torch.lerp(centered[cameras, before], centered[cameras, before + 1], share).exp()

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group, "exposure"."""
        return [ParameterGroup("exposure", (self.logarithms,))]
