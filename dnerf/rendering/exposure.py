"""Exposure and white balance that drift through a film, which are the camera's, not the scene's."""

import torch
from torch import Tensor, nn

from dnerf.core.checks import check_whole
from dnerf.nn.parameter_groups import DeclaresGroups, ParameterGroup


class Exposure(nn.Module, DeclaresGroups):
    """Factors `exp(e(t) - mean e)` of red, green and blue, with e learnt at even times and linear between them.

    They begin at 1. Their geometric mean over those times stays 1, since the scene could be brighter instead.

    Args:
        num_times: at which factors are learnt. Frames that are closer together share them.

    Raises:
        ValueError: for fewer than two times.
    """

    def __init__(self, num_times: int = 32) -> None:
        super().__init__()
        check_whole("num_times", num_times)
        if num_times < 2:
            raise ValueError(f"num_times must be at least 2, got {num_times}")
        self.logarithms = nn.Parameter(torch.zeros(num_times, 3))

    def forward(self, rgb: Tensor, times: Tensor) -> Tensor:
        """What the camera shows of colours (R, 3) at times (R,) in [0, 1]."""
        places = times * (len(self.logarithms) - 1)
        before = places.detach().long().clamp(0, len(self.logarithms) - 2)
        centered = self.logarithms - self.logarithms.mean(0)
        share = (places - before)[:, None]
        return rgb * torch.lerp(centered[before], centered[before + 1], share).exp()

    def parameter_groups(self) -> list[ParameterGroup]:
        """One group, "exposure"."""
        return [ParameterGroup("exposure", (self.logarithms,))]
