"""Velocity fields whose flow maps have a closed form: the truth that solvers are measured against."""

from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor, nn

from dnerf.deformations import FlowDeformation
from dnerf.deformations.velocities import Velocity


class ClosedFlow(Velocity):
    """A velocity field with its exact flow map. It fills all space: no window."""

    @abstractmethod
    def carry(self, positions: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Where points (..., 3) at times `start` (...,) are at times `end` (...,)."""


class Rotation(ClosedFlow):
    """v = omega z x p: a turn about the z axis.

    Args:
        rate: omega, in radians per unit of time.
    """

    def __init__(self, rate: float = 2.0) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3)."""
        x, y, z = positions.unbind(-1)
        return self.rate * torch.stack([-y, x, torch.zeros_like(z)], dim=-1)

    def carry(self, positions: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Turned by rate times elapsed time."""
        return turn_about_z(positions, self.rate * (end - start))


class Shear(ClosedFlow):
    """v = (a cos(b t) y, 0, 0): layers that slide to and fro.

    Args:
        amplitude: a.
        frequency: b, in radians per unit of time.
    """

    def __init__(self, amplitude: float = 2.0, frequency: float = 5.0) -> None:
        super().__init__()
        self.amplitude = amplitude
        self.frequency = frequency

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3)."""
        along = self.amplitude * torch.cos(self.frequency * times) * positions[..., 1]
        return torch.stack([along, torch.zeros_like(along), torch.zeros_like(along)], dim=-1)

    def carry(self, positions: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Slid by the integral of the cosine."""
        swing = torch.sin(self.frequency * end) - torch.sin(self.frequency * start)
        x, y, z = positions.unbind(-1)
        return torch.stack([x + self.amplitude / self.frequency * swing * y, y, z], dim=-1)


class Expansion(ClosedFlow):
    """v = k p: everything grows by exp(k t).

    Args:
        rate: k, in 1 / time.
    """

    def __init__(self, rate: float = 1.5) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3)."""
        return self.rate * positions

    def carry(self, positions: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Scaled by exp(k elapsed)."""
        return positions * torch.exp(self.rate * (end - start))[..., None]


class Swirl(ClosedFlow):
    """A turn about the z axis whose rate depends on the distance r from it and on time: a (1 + r^2) cos(b t).

    Args:
        amplitude: a, in radians per unit of time.
        frequency: b, in radians per unit of time.
    """

    def __init__(self, amplitude: float = 1.5, frequency: float = 4.0) -> None:
        super().__init__()
        self.amplitude = amplitude
        self.frequency = frequency

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        """Velocity (..., 3)."""
        x, y, z = positions.unbind(-1)
        rate = self.amplitude * (1 + x * x + y * y) * torch.cos(self.frequency * times)
        return torch.stack([-rate * y, rate * x, torch.zeros_like(z)], dim=-1)

    def carry(self, positions: Tensor, start: Tensor, end: Tensor) -> Tensor:
        """Turned by the integral of the rate: the distance from the axis never changes."""
        squared = positions[..., :2].square().sum(-1)
        swing = (torch.sin(self.frequency * end) - torch.sin(self.frequency * start)) / self.frequency
        return turn_about_z(positions, self.amplitude * (1 + squared) * swing)


def turn_about_z(positions: Tensor, angles: Tensor) -> Tensor:
    """Points (..., 3) turned about the z axis by angles (...,) in radians."""
    x, y, z = positions.unbind(-1)
    cosine, sine = torch.cos(angles), torch.sin(angles)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1)


CLOSED_FLOWS: dict[str, type[ClosedFlow]] = {
    "rotation": Rotation, "shear": Shear, "expansion": Expansion, "swirl": Swirl
}  # fmt: skip


class _CountedVelocity(Velocity):
    def __init__(self, velocity: Velocity) -> None:
        super().__init__()
        self.velocity = velocity
        self.count = 0

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.at(times)(positions)

    def at(self, times: Tensor) -> Callable[[Tensor], Tensor]:
        field = self.velocity.at(times)

        def counted(positions: Tensor) -> Tensor:
            self.count += 1
            return field(positions)

        return counted


def count_evaluations(deformation: nn.Module, call: Callable[..., object], *arguments: Tensor) -> int:
    """How often a call evaluates the velocity fields of a deformation's flows, each time at a whole batch."""
    flows = [module for module in deformation.modules() if isinstance(module, FlowDeformation)]
    counted = [_CountedVelocity(flow.velocity) for flow in flows]
    try:
        for flow, velocity in zip(flows, counted, strict=True):
            flow.velocity = velocity
        call(*arguments)
    finally:
        for flow, velocity in zip(flows, counted, strict=True):
            flow.velocity = velocity.velocity
    return sum(velocity.count for velocity in counted)
