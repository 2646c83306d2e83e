"""Colours of bodies as functions of the place on the body, so that a material point keeps its colour as it moves."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from dnerf.geometry import safe_normalize
from dnerf.scenes.motions import Vector, constant

Plane = tuple[Vector, float]

LIGHT: Vector = (0.36, 0.48, 0.8)
"""Unit vector towards the light that scenes share unless they say otherwise."""


class Texture(ABC):
    """Colour in a body's frame. Between its `breaks` it is smooth along every ray."""

    @abstractmethod
    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """Colour (..., 3) in [0, 1], all arguments in the body's frame.

        Args:
            points: (..., 3) inside the body.
            normals: (..., 3) of the shape there, see `Shape.normals`.
            directions: (..., 3) unit viewing directions.
        """

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Distances (R, M) along lines at which the colour jumps; may be infinite, need not be sorted."""
        return origins[:, :0]


@dataclass(frozen=True)
class Plain(Texture):
    """One colour."""

    rgb: Vector

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """The colour, expanded."""
        return constant(self.rgb, points).expand_as(points)


@dataclass(frozen=True)
class Gradient(Texture):
    """Blend along the normal's direction: `low` where the surface faces against the axis, `high` where along it."""

    low: Vector
    high: Vector
    axis: Vector = (0.0, 0.0, 1.0)

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """Linear in the normal."""
        share = 0.5 + 0.5 * (normals * constant(self.axis, points)).sum(-1, keepdim=True)
        return torch.lerp(constant(self.low, points), constant(self.high, points), share)


@dataclass(frozen=True)
class Glow(Texture):
    """Blend from the middle outwards: `core` at the centre, `rim` at the given radius of the body's frame."""

    core: Vector
    rim: Vector
    radius: float

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """Quadratic in the distance from the centre."""
        share = (points * points).sum(-1, keepdim=True) / self.radius**2
        return torch.lerp(constant(self.core, points), constant(self.rim, points), share)


@dataclass(frozen=True)
class Stripes(Texture):
    """Two textures in turn, one sine wave along an axis.

    Args:
        first: where the sine is -1.
        second: where it is 1.
        wave_vector: 2 pi / wavelength along the axis.
    """

    first: Texture
    second: Texture
    wave_vector: Vector

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """Sinusoidal blend."""
        phase = (points * constant(self.wave_vector, points)).sum(-1, keepdim=True)
        first = self.first.color(points, normals, directions)
        second = self.second.color(points, normals, directions)
        return torch.lerp(first, second, 0.5 + 0.5 * torch.sin(phase))

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Those of both."""
        return torch.cat([t.breaks(origins, directions) for t in (self.first, self.second)], dim=-1)


@dataclass(frozen=True)
class Checker(Texture):
    """Two textures in turn: every plane crossed changes from one to the other.

    Args:
        first: where a point lies in front of an even number of planes.
        second: where the number is odd.
        planes: (normal, offset) each; a point is in front where normal . x > offset.
    """

    first: Texture
    second: Texture
    planes: tuple[Plane, ...]

    def _heights(self, vectors: Tensor, index: int) -> Tensor:
        return (vectors * constant(self.planes[index][0], vectors)).sum(-1)

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """One of both, by the parity of the number of planes in front of which a point lies."""
        odd = torch.zeros_like(points[..., 0], dtype=torch.bool)
        for index, (_, offset) in enumerate(self.planes):
            odd = odd ^ (self._heights(points, index) > offset)
        first = self.first.color(points, normals, directions)
        second = self.second.color(points, normals, directions)
        return torch.where(odd[..., None], second, first)

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Crossings of the planes, and the breaks of both textures."""
        found = [t.breaks(origins, directions) for t in (self.first, self.second)]
        for index, (_, offset) in enumerate(self.planes):
            slope = self._heights(directions, index)
            parallel = slope == 0
            distance = (offset - self._heights(origins, index)) / torch.where(parallel, 1.0, slope)
            found.append(torch.where(parallel, torch.inf, distance)[:, None])
        return torch.cat(found, dim=-1)


def grid_planes(cell: float, count: int, axes: str = "xyz") -> tuple[Plane, ...]:
    """Planes across the named axes at -count, ..., count times `cell`: a chessboard of cubes about the origin."""
    units: dict[str, Vector] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    return tuple((units[axis], k * cell) for axis, k in product(axes, range(-count, count + 1)))


def sector_planes(count: int) -> tuple[Plane, ...]:
    """Planes through the z axis: 2 * count equal sectors, as on a beach ball."""
    angles = [math.pi * k / count for k in range(count)]
    return tuple(((math.cos(a), math.sin(a), 0.0), 0.0) for a in angles)


@dataclass(frozen=True)
class Lit(Texture):
    """Another texture under soft light: full colour facing the light, shaded where turned away from it.

    With the normal n and the light's direction l the factor is shade + (1 - shade) ((1 + n . l) / 2)^2 ("half
    Lambert", Mitchell et al. 2006). The light is part of the body and turns with it.

    Args:
        base: the colour in full light.
        light: unit vector towards the light, in the body's frame.
        shade: factor per channel facing away; a bluish one looks like sky light.
    """

    base: Texture
    light: Vector = LIGHT
    shade: Vector = (0.5, 0.51, 0.58)

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """The base colour, shaded."""
        facing = 0.5 + 0.5 * (normals * constant(self.light, points)).sum(-1, keepdim=True)
        shade = constant(self.shade, points)
        return self.base.color(points, normals, directions) * (shade + (1 - shade) * facing**2)

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Those of the base."""
        return self.base.breaks(origins, directions)


@dataclass(frozen=True)
class Shadowed(Texture):
    """Another texture with soft round shadows painted on it, for things that stand on a body at rest.

    Args:
        base: the colour without shadows.
        spots: (x, y, radius) each: a Gaussian spot in the body's xy plane.
        strength: share of the light missing in the middle of a spot, in [0, 1].
    """

    base: Texture
    spots: tuple[Vector, ...]
    strength: float = 0.6

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """The base colour, darker in the spots."""
        color = self.base.color(points, normals, directions)
        for x, y, radius in self.spots:
            squared = (points[..., :1] - x) ** 2 + (points[..., 1:2] - y) ** 2
            color = color * (1 - self.strength * torch.exp(-squared / radius**2))
        return color

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Those of the base."""
        return self.base.breaks(origins, directions)


@dataclass(frozen=True)
class Glossy(Texture):
    """Another texture with a highlight that moves with the eye.

    With the half vector h between eye and light (Blinn 1977): colour + strength exp(-|n - h|^2 / width^2) (1 - colour).
    The Gaussian stands for Blinn's power of n . h because it hardly notices that n shortens below the surface.

    Args:
        base: the colour without highlight.
        light: unit vector towards the light, in the body's frame.
        strength: of the highlight, in [0, 1].
        width: of the highlight, about its radius on a unit ball.
    """

    base: Texture
    light: Vector = LIGHT
    strength: float = 0.9
    width: float = 0.16

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        """The base colour and the highlight."""
        half = safe_normalize(constant(self.light, points) - directions)
        squared = ((normals - half) ** 2).sum(-1, keepdim=True)
        color = self.base.color(points, normals, directions)
        return color + self.strength * torch.exp(-squared / self.width**2) * (1 - color)

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Those of the base."""
        return self.base.breaks(origins, directions)
