"""Motions of bodies: poses as smooth functions of time, composed like the links of a chain."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dnerf.geometry import so3_exp
from dnerf.scenes.poses import Pose, turn

Vector = tuple[float, float, float]


def constant(values: Vector, like: Tensor) -> Tensor:
    """Three numbers as a (3,) tensor with another tensor's device and dtype."""
    return torch.tensor(values, dtype=like.dtype, device=like.device)


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
    """Height above the ground of what falls and bounces without loss: parabolas, `4 height s (1 - s)`, s from 0 to 1.

    With a whole number of bounces it is the same at t = 1 as at t = 0. The velocity jumps where the ground is met.

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


class Motion(ABC):
    """Where a body's frame is at each time, relative to a parent's frame or to the world."""

    parent: "Motion | None" = None

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
class Fixed(Motion):
    """A frame that never moves.

    Args:
        translation: its origin in world units.
        rotation_vector: axis times angle in radians.
    """

    translation: Vector = (0.0, 0.0, 0.0)
    rotation_vector: Vector = (0.0, 0.0, 0.0)

    def relative(self, times: Tensor) -> Pose:
        """The same pose at every time."""
        rotation = so3_exp(constant(self.rotation_vector, times))
        translation = constant(self.translation, times)
        shape = times.shape
        return Pose(rotation.expand(*shape, 3, 3), translation.expand(*shape, 3), torch.ones_like(times))


@dataclass(frozen=True)
class Orbit(Motion):
    """A circle run through at constant speed without turning the frame: shading baked into a texture stays put.

    Args:
        radius: of the circle, in world units.
        turns: circles run through while t goes from 0 to 1; negative runs clockwise.
        phase: where it starts, in turns.
        tilt: angle of the circle's plane about the x axis, in radians.
        center: of the circle.
    """

    radius: float
    turns: float = 1.0
    phase: float = 0.0
    tilt: float = 0.0
    center: Vector = (0.0, 0.0, 0.0)

    def relative(self, times: Tensor) -> Pose:
        """Pose on the circle."""
        angle = 2 * math.pi * (self.turns * times + self.phase)
        along, across = self.radius * torch.cos(angle), self.radius * torch.sin(angle)
        circle = torch.stack([along, across * math.cos(self.tilt), across * math.sin(self.tilt)], dim=-1)
        identity = Pose.identity(times)
        return Pose(identity.rotation, circle + constant(self.center, times), identity.scale)


@dataclass(frozen=True)
class Joint(Motion):
    """A frame hinged to a parent's at a point, turning about an axis.

    Args:
        parent: motion of the frame it hangs on; the world if None.
        offset: the joint, in the parent's frame.
        axis: in the parent's frame.
        angle: in radians.
    """

    parent: Motion | None = None
    offset: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    angle: Wave = field(default_factory=Wave)

    def relative(self, times: Tensor) -> Pose:
        """The joint."""
        rotation = turn(self.axis, self.angle(times))
        offset = constant(self.offset, times).expand(*times.shape, 3)
        return Pose(rotation, offset, torch.ones_like(times))


@dataclass(frozen=True)
class Spin(Motion):
    """A frame that turns at constant speed relative to its parent.

    Args:
        parent: motion of the frame it turns in; the world if None.
        axis: in the parent's frame.
        turns: while t goes from 0 to 1.
    """

    parent: Motion | None = None
    axis: Vector = (0.0, 0.0, 1.0)
    turns: float = 1.0

    def relative(self, times: Tensor) -> Pose:
        """The turn so far."""
        rotation = turn(self.axis, 2 * math.pi * self.turns * times)
        identity = Pose.identity(times)
        return Pose(rotation, identity.translation, identity.scale)


@dataclass(frozen=True)
class Slide(Motion):
    """A frame that moves to and fro along an axis of its parent.

    Args:
        parent: motion of the frame it slides in; the world if None.
        axis: direction in the parent's frame.
        distance: along the axis, in world units if the axis is a unit vector.
    """

    parent: Motion | None = None
    axis: Vector = (0.0, 0.0, 1.0)
    distance: Wave | Bounce = field(default_factory=Wave)

    def relative(self, times: Tensor) -> Pose:
        """The shift."""
        shift = self.distance(times)[..., None] * constant(self.axis, times)
        identity = Pose.identity(times)
        return Pose(identity.rotation, shift, identity.scale)


@dataclass(frozen=True)
class Pulse(Motion):
    """A frame that grows and shrinks about its origin.

    Args:
        parent: motion of the frame it pulses in; the world if None.
        scale: factor, positive at all times.
    """

    parent: Motion | None = None
    scale: Wave = field(default_factory=lambda: Wave(1.0))

    def relative(self, times: Tensor) -> Pose:
        """The scaling."""
        identity = Pose.identity(times)
        return Pose(identity.rotation, identity.translation, self.scale(times))


@dataclass(frozen=True)
class Jump(Motion):
    """A frame that stands still and jumps: discontinuous in time, and at t = 1 back where it was at t = 0.

    Args:
        places: of its origin, in the parent's frame, each for an equal share of [0, 1].
        parent: motion of the frame it jumps in; the world if None.

    Raises:
        ValueError: without places.
    """

    places: tuple[Vector, ...] = ((0.0, 0.0, 0.0),)
    parent: Motion | None = None

    def __post_init__(self) -> None:
        if not self.places:
            raise ValueError("places must hold at least one place, got none")

    def relative(self, times: Tensor) -> Pose:
        """The place of the moment."""
        places = torch.tensor(self.places, dtype=times.dtype, device=times.device)
        identity = Pose.identity(times)
        index = (times.detach() * len(self.places)).long() % len(self.places)
        return Pose(identity.rotation, places[index], identity.scale)


@dataclass(frozen=True)
class Vanish(Motion):
    """A frame whose body is not there for a while.

    Args:
        gone: from when to when, within (0, 1); the end belongs to the time it is there again.
        parent: motion of the frame; the world if None.

    Raises:
        ValueError: unless 0 < from < to < 1.
    """

    gone: tuple[float, float] = (0.4, 0.7)
    parent: Motion | None = None

    def __post_init__(self) -> None:
        if not 0 < self.gone[0] < self.gone[1] < 1:
            raise ValueError(f"gone must be two increasing times in (0, 1), got {self.gone}")

    def relative(self, times: Tensor) -> Pose:
        """The parent's own frame, present or not."""
        identity = Pose.identity(times)
        there = (times < self.gone[0]) | (times >= self.gone[1])
        return Pose(identity.rotation, identity.translation, identity.scale, there.to(times.dtype))
