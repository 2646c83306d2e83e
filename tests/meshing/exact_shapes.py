"""Exact fields and deformations, of which surface, volume and motion are known."""

from collections.abc import Callable

import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.geometry import so3_exp
from dnerf.deformations import Deformation, InvertibleDeformation
from dnerf.fields import RadianceField, SignedDistance

BOX = ((-1.0, -0.9, -0.8), (1.0, 0.9, 0.8))
CENTER = torch.tensor([0.0313, -0.0171, 0.0227])  # no vertex falls on a lattice point

Distance = Callable[[Tensor], Tensor]


def ball(x: Tensor) -> Tensor:
    return (x - CENTER).norm(dim=-1) - 0.5


def box(x: Tensor) -> Tensor:
    beyond = (x - CENTER).abs() - torch.tensor([0.5, 0.4, 0.3])
    return beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)


def capsule(x: Tensor) -> Tensor:
    end = torch.tensor([0.3, 0.2, 0.4])
    offset = x - CENTER + 0.5 * end
    along = (offset @ end / end.square().sum()).clamp(0, 1)
    return (offset - along[..., None] * end).norm(dim=-1) - 0.3


def torus(x: Tensor) -> Tensor:
    x = x - CENTER
    return torch.hypot(x[..., :2].norm(dim=-1) - 0.5, x[..., 2]) - 0.2


class ExactSurface(RadianceField, SignedDistance):
    """A signed distance, larger by `growth` times the time; its colour is half of one minus the direction."""

    def __init__(self, shape: Distance, growth: float = 0.0) -> None:
        super().__init__()
        self.shape, self.growth = shape, growth

    def distance(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.shape(positions) - self.growth * times

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return 100.0 * (self.distance(positions, times) < 0)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), 0.5 - 0.5 * directions)


class Fog(RadianceField):
    """A density that falls exponentially with a distance: it is `level` where that is zero."""

    def __init__(self, shape: Distance, level: float = 30.0, steepness: float = 60.0) -> None:
        super().__init__()
        self.shape, self.level, self.steepness = shape, level, steepness

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.level * torch.exp(-self.steepness * self.shape(positions))

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.full_like(positions, 0.5))


class Rigid(Deformation):
    """A body that turns and travels: canonical = R(t)^T (world - t v)."""

    spin, velocity = torch.tensor([0.4, -0.3, 1.5]), torch.tensor([0.2, 0.1, -0.3])

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        turn = so3_exp(times[..., None] * self.spin)
        return ((positions - times[..., None] * self.velocity)[..., None, :] @ turn)[..., 0, :]

    def world(self, canonical: Tensor, times: Tensor) -> Tensor:
        """Where canonical positions are."""
        turn = so3_exp(times[..., None] * self.spin)
        return (turn @ canonical[..., None])[..., 0] + times[..., None] * self.velocity


class InvertibleRigid(Rigid, InvertibleDeformation):
    """The same, with its inverse."""

    def inverse(self, canonical: Tensor, times: Tensor) -> Tensor:
        return self.world(canonical, times)
