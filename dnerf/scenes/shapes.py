"""Convex shapes in their own frame: inside or not, where a line enters and leaves, which way the surface faces."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.core.geometry import ray_box

Vector = tuple[float, float, float]


def constant(values: Vector, like: Tensor) -> Tensor:
    """Three numbers as a (3,) tensor with another tensor's device and dtype."""
    return torch.tensor(values, dtype=like.dtype, device=like.device)


class Shape(ABC):
    """A convex solid around its frame's origin."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[Vector, Vector]:
        """Lowest and highest corner of the axis-aligned box around it."""

    @abstractmethod
    def excess(self, points: Tensor) -> Tensor:
        """How far points (..., 3) are outside, (...,): <= 0 inside; it changes by at most 1 per unit of length."""

    def distance(self, points: Tensor) -> Tensor:
        """Signed distance (...,) from the surface of points (..., 3), negative inside."""
        return self.excess(points)

    def contains(self, points: Tensor) -> Tensor:
        """Whether points (..., 3) lie inside, (...,) bool."""
        return self.excess(points) <= 0

    @abstractmethod
    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distances at which lines enter and leave, in units of the direction's length.

        Args:
            origins: (R, 3).
            directions: (R, 3), of any positive length.

        Returns:
            enter, leave: (R,); a line that misses or touches has `enter >= leave`.
        """

    @abstractmethod
    def normals(self, points: Tensor) -> Tensor:
        """About the outward normals of the surface, continued inside as polynomials: shading is smooth along rays.

        Args:
            points: (..., 3) inside.

        Returns:
            (..., 3), length at most 1, near 1 on most of the surface.
        """


def _ball_crossing(origins: Tensor, directions: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Lines (R, D) against the ball (or disc) |x| <= radius about the origin.

    From the point of closest approach rather than from b^2 - 4ac, which loses half the digits far from the ball.
    """
    squared = (directions * directions).sum(-1)
    parallel = squared == 0
    squared = torch.where(parallel, 1.0, squared)
    middle = -(origins * directions).sum(-1) / squared
    nearest = (origins + middle[..., None] * directions).norm(dim=-1)
    below = (radius - nearest) * (radius + nearest)
    # A direction of length zero (a line along a cylinder's axis) is inside all the way, or nowhere.
    half = torch.where(parallel, torch.inf, (below.clamp(min=0) / squared).sqrt())
    middle = torch.where(parallel, 0.0, middle)
    hits = below > 0
    return torch.where(hits, middle - half, torch.inf), torch.where(hits, middle + half, -torch.inf)


@dataclass(frozen=True)
class Ball(Shape):
    """A ball of the given radius."""

    radius: float

    def __post_init__(self) -> None:
        check_positive("radius", self.radius)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        r = self.radius
        return (-r, -r, -r), (r, r, r)

    def excess(self, points: Tensor) -> Tensor:
        """Distance from the surface, with its sign."""
        return points.norm(dim=-1) - self.radius

    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        return _ball_crossing(origins, directions, self.radius)

    def normals(self, points: Tensor) -> Tensor:
        """x / radius: exact at the surface, linear inside."""
        return points / self.radius


@dataclass(frozen=True)
class Box(Shape):
    """A box with the given half edge lengths, its faces across the axes."""

    half_sizes: Vector

    def __post_init__(self) -> None:
        for size in self.half_sizes:
            check_positive("half_sizes", size)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        x, y, z = self.half_sizes
        return (-x, -y, -z), (x, y, z)

    def excess(self, points: Tensor) -> Tensor:
        """By how much the worst coordinate is beyond its face."""
        return (points.abs() - constant(self.half_sizes, points)).amax(-1)

    def distance(self, points: Tensor) -> Tensor:
        """By all coordinates that are beyond their faces; inside, by the nearest face."""
        beyond = points.abs() - constant(self.half_sizes, points)
        return beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)

    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The slab method."""
        half = constant(self.half_sizes, origins)
        return ray_box(origins, directions, torch.stack([-half, half]))

    def normals(self, points: Tensor) -> Tensor:
        """Cubes of the relative coordinates q, less towards the edges: q_i^3 (1 - a sum_{j != i} q_j^4).

        With a = 1 - sqrt(1/2) the length is 1 in the middle of a face and of an edge.
        """
        relative = points / constant(self.half_sizes, points)
        fourth = relative**4
        others = fourth.sum(-1, keepdim=True) - fourth
        return relative**3 * (1 - (1 - math.sqrt(0.5)) * others)


@dataclass(frozen=True)
class Capsule(Shape):
    """All points within a radius of the segment from the origin to `end`."""

    radius: float
    end: Vector

    def __post_init__(self) -> None:
        check_positive("radius", self.radius)
        check_positive("length of end", self.length)

    @property
    def length(self) -> float:
        """Of the segment."""
        return math.hypot(*self.end)

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        (x, y, z), r = self.end, self.radius
        low = (min(0.0, x) - r, min(0.0, y) - r, min(0.0, z) - r)
        return low, (max(0.0, x) + r, max(0.0, y) + r, max(0.0, z) + r)

    def _split(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Components of vectors (..., 3) along the axis (...,) and across it (..., 3)."""
        axis = constant(self.end, vectors) / self.length
        along = (vectors * axis).sum(-1)
        return along, vectors - along[..., None] * axis

    def excess(self, points: Tensor) -> Tensor:
        """Distance from the surface, with its sign."""
        along, across = self._split(points)
        return torch.hypot(along - along.clamp(0, self.length), across.norm(dim=-1)) - self.radius

    def intersect(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Hull of the crossings of its three convex parts, two balls and a cylinder: their union is convex."""
        first = _ball_crossing(origins, directions, self.radius)
        second = _ball_crossing(origins - constant(self.end, origins), directions, self.radius)
        (height, across), (rise, sideways) = self._split(origins), self._split(directions)
        tube = _ball_crossing(across, sideways, self.radius)
        level = rise == 0
        rise = torch.where(level, 1.0, rise)
        low, high = -height / rise, (self.length - height) / rise
        # A line across the axis is between the ends all the way, or nowhere.
        unbounded = torch.where((height >= 0) & (height <= self.length), torch.inf, -torch.inf).to(low.dtype)
        enter = torch.maximum(tube[0], torch.where(level, -unbounded, torch.minimum(low, high)))
        leave = torch.minimum(tube[1], torch.where(level, unbounded, torch.maximum(low, high)))
        hits = leave > enter
        enter, leave = torch.where(hits, enter, torch.inf), torch.where(hits, leave, -torch.inf)
        enter = torch.minimum(enter, torch.minimum(first[0], second[0]))
        return enter, torch.maximum(leave, torch.maximum(first[1], second[1]))

    def normals(self, points: Tensor) -> Tensor:
        """Away from the axis, bending to the axis towards the tips: a polynomial, the steeper the longer it is."""
        axis = constant(self.end, points) / self.length
        along, across = self._split(points)
        half = 0.5 * self.length
        tip = ((along - half) / (half + self.radius)) ** (2 * math.ceil(half / self.radius) + 3)
        return 0.99 * (across / self.radius + tip[..., None] * axis)
