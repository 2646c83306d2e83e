"""Motions of bodies: poses as smooth functions of time, composed like the links of a chain."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dnerf.scenes.poses import Pose, turn
from dnerf.scenes.shapes import Vector, constant


@dataclass(frozen=True)
class Wave:
    """Sum of sines: mean + sum_k amplitude_k sin(2 pi (cycles_k t + phase_k)).

    With whole numbers of cycles it is the same at t = 1 as at t = 0.

    Args:
        mean: value around which it swings.
        harmonics: (amplitude, cycles, phase) each, the phase in turns.
    """

    mean: float = 0.0
    harmonics: tuple[Vector, ...] = ()

    def __call__(self, times: Tensor) -> Tensor:
        """Value (...,) at times (...,)."""
        value = torch.full_like(times, self.mean)
        for amplitude, cycles, phase in self.harmonics:
            value = value + amplitude * torch.sin(2 * math.pi * (cycles * times + phase))
        return value


@dataclass(frozen=True)
class Bounce:
    """Height of what bounces without loss: parabolas `4 height s (1 - s)`, s from 0 to 1; the velocity jumps at 0.

    With a whole number of bounces it is the same at t = 1 as at t = 0.

    Args:
        height: of the apex, in world units.
        bounces: arcs while t goes from 0 to 1.
        phase: share of an arc that is over at t = 0.
    """

    height: float
    bounces: float = 1.0
    phase: float = 0.0

    def __call__(self, times: Tensor) -> Tensor:
        """Height (...,) at times (...,)."""
        arc = torch.remainder(self.bounces * times + self.phase, 1.0)
        return 4 * self.height * arc * (1 - arc)


@dataclass(frozen=True)
class Motion(ABC):
    """Where a body's frame is at each time.

    Args:
        parent: motion of the frame relative to which it moves; the world if None.
    """

    parent: "Motion | None" = field(default=None, kw_only=True)

    @abstractmethod
    def relative(self, times: Tensor) -> Pose:
        """Pose of the frame in its parent's at times (...,)."""

    def pose(self, times: Tensor) -> Pose:
        """Pose of the frame in the world at times (...,)."""
        return world_poses([self], times)[0]


def world_poses(motions: Sequence[Motion], times: Tensor) -> list[Pose]:
    """Poses of several frames in the world at times (...,), each link that they share worked out once."""
    known: dict[int, Pose] = {}

    def resolve(motion: Motion) -> Pose:
        if id(motion) not in known:
            own = motion.relative(times)
            known[id(motion)] = own if motion.parent is None else resolve(motion.parent).then(own)
        return known[id(motion)]

    return [resolve(motion) for motion in motions]


@dataclass(frozen=True)
class Joint(Motion):
    """A frame hinged at a point of its parent's (`offset`), turning about an axis there by an angle in radians."""

    offset: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    angle: Wave = field(default_factory=Wave)

    def relative(self, times: Tensor) -> Pose:
        offset = constant(self.offset, times).expand(*times.shape, 3)
        return Pose.at(times, rotation=turn(self.axis, self.angle(times)), translation=offset)


@dataclass(frozen=True)
class Fixed(Motion):
    """A frame that stands still with its origin at a place in the parent's frame."""

    translation: Vector = (0.0, 0.0, 0.0)

    def relative(self, times: Tensor) -> Pose:
        return Pose.at(times, translation=constant(self.translation, times).expand(*times.shape, 3))


@dataclass(frozen=True)
class Orbit(Motion):
    """A circle run through at constant speed without turning the frame: shading baked into a texture stays put.

    Args:
        radius: of the circle, in world units.
        turns: circles run through while t goes from 0 to 1; negative runs clockwise.
        phase: where it starts, in turns.
        tilt: angle of the circle's plane about the x axis, in radians.
    """

    radius: float
    turns: float = 1.0
    phase: float = 0.0
    tilt: float = 0.0

    def relative(self, times: Tensor) -> Pose:
        angle = 2 * math.pi * (self.turns * times + self.phase)
        along, across = self.radius * torch.cos(angle), self.radius * torch.sin(angle)
        circle = torch.stack([along, across * math.cos(self.tilt), across * math.sin(self.tilt)], dim=-1)
        return Pose.at(times, translation=circle)


@dataclass(frozen=True)
class Spin(Motion):
    """A frame that turns about the z axis at constant speed, a number of turns while t goes from 0 to 1."""

    turns: float = 1.0

    def relative(self, times: Tensor) -> Pose:
        return Pose.at(times, rotation=turn((0.0, 0.0, 1.0), 2 * math.pi * self.turns * times))


@dataclass(frozen=True)
class Slide(Motion):
    """A frame that moves to and fro along an axis of its parent's; the distance is in lengths of the axis."""

    distance: Wave | Bounce
    axis: Vector = (0.0, 0.0, 1.0)

    def relative(self, times: Tensor) -> Pose:
        return Pose.at(times, translation=self.distance(times)[..., None] * constant(self.axis, times))


@dataclass(frozen=True)
class Pulse(Motion):
    """A frame that grows and shrinks about its origin by a factor that is positive at all times."""

    scale: Wave

    def relative(self, times: Tensor) -> Pose:
        return Pose.at(times, scale=self.scale(times))


@dataclass(frozen=True)
class Jump(Motion):
    """A frame that jumps from place to place of its parent's, each for an equal share of [0, 1]; t = 1 is t = 0 again.

    Raises:
        ValueError: without places.
    """

    places: tuple[Vector, ...]

    def __post_init__(self) -> None:
        if not self.places:
            raise ValueError("places must hold at least one place, got none")

    def relative(self, times: Tensor) -> Pose:
        places = torch.tensor(self.places, dtype=times.dtype, device=times.device)
        return Pose.at(times, translation=places[(times.detach() * len(places)).long() % len(places)])


@dataclass(frozen=True)
class Vanish(Motion):
    """The parent's frame, whose body is gone from one time in (0, 1) to another; at the second it is there again.

    Raises:
        ValueError: unless 0 < from < to < 1.
    """

    gone: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0 < self.gone[0] < self.gone[1] < 1:
            raise ValueError(f"gone must be two increasing times in (0, 1), got {self.gone}")

    def relative(self, times: Tensor) -> Pose:
        there = (times < self.gone[0]) | (times >= self.gone[1])
        return Pose.at(times, presence=there.to(times.dtype))
