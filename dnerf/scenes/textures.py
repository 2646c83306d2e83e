"""Colours of bodies as functions of the place on the body, so that a material point keeps its colour as it moves."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from dnerf.core.geometry import safe_normalize
from dnerf.scenes.shapes import Vector, constant

Plane = tuple[Vector, float]

LIGHT: Vector = (0.36, 0.48, 0.8)
"""Unit vector towards the light that scenes share unless they say otherwise."""
SHADE: Vector = (0.5, 0.51, 0.58)
"""Factor per channel of colour that faces away from the light: bluish, like sky light."""


def _along(vectors: Tensor, axis: Vector) -> Tensor:
    """Inner products (..., 1) of vectors (..., 3) with an axis."""
    return (vectors * constant(axis, vectors)).sum(-1, keepdim=True)


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
        """Distances (R, M) along lines at which the colour jumps, in any order, some infinite: those of its parts."""
        parts = [part for part in vars(self).values() if isinstance(part, Texture)]
        return torch.cat([origins[:, :0], *(part.breaks(origins, directions) for part in parts)], dim=-1)


@dataclass(frozen=True)
class Plain(Texture):
    """One colour."""

    rgb: Vector

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        return constant(self.rgb, points).expand_as(points)


@dataclass(frozen=True)
class Gradient(Texture):
    """Linear blend by the normal: `low` where the surface faces against the axis, `high` where along it."""

    low: Vector
    high: Vector
    axis: Vector = (0.0, 0.0, 1.0)

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        share = 0.5 + 0.5 * _along(normals, self.axis)
        return torch.lerp(constant(self.low, points), constant(self.high, points), share)


@dataclass(frozen=True)
class Glow(Texture):
    """Blend with the squared distance from the centre, from `core` to `rim` at the given radius."""

    core: Vector
    rim: Vector
    radius: float

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        share = (points * points).sum(-1, keepdim=True) / self.radius**2
        return torch.lerp(constant(self.core, points), constant(self.rim, points), share)


@dataclass(frozen=True)
class Pattern(Texture):
    """Two textures in turn."""

    first: Texture
    second: Texture

    @abstractmethod
    def share(self, points: Tensor) -> Tensor:
        """Share (..., 1) of the second texture at points (..., 3), in [0, 1]."""

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        first, second = (texture.color(points, normals, directions) for texture in (self.first, self.second))
        return torch.lerp(first, second, self.share(points))


@dataclass(frozen=True)
class Stripes(Pattern):
    """Two textures in turn along a sine wave, the second at its crests; `wave_vector` has length 2 pi / wavelength."""

    wave_vector: Vector

    def share(self, points: Tensor) -> Tensor:
        return 0.5 + 0.5 * torch.sin(_along(points, self.wave_vector))


@dataclass(frozen=True)
class Checker(Pattern):
    """Two textures in turn: the second where normal . x > offset for an odd number of planes (normal, offset)."""

    planes: tuple[Plane, ...]

    def share(self, points: Tensor) -> Tensor:
        odd = torch.zeros_like(points[..., :1], dtype=torch.bool)
        for normal, offset in self.planes:
            odd = odd ^ (_along(points, normal) > offset)
        return odd.to(points.dtype)

    def breaks(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Crossings of the planes, and the breaks of both textures."""
        found = [super().breaks(origins, directions)]
        for normal, offset in self.planes:
            slope = _along(directions, normal)
            distance = (offset - _along(origins, normal)) / torch.where(slope == 0, 1.0, slope)
            found.append(torch.where(slope == 0, torch.inf, distance))
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
    """

    base: Texture
    light: Vector = LIGHT

    def color(self, points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
        facing, shade = 0.5 + 0.5 * _along(normals, self.light), constant(SHADE, points)
        return self.base.color(points, normals, directions) * (shade + (1 - shade) * facing**2)


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
        color = self.base.color(points, normals, directions)
        for x, y, radius in self.spots:
            squared = (points[..., :1] - x) ** 2 + (points[..., 1:2] - y) ** 2
            color = color * (1 - self.strength * torch.exp(-squared / radius**2))
        return color


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
        half = safe_normalize(constant(self.light, points) - directions)
        squared = ((normals - half) ** 2).sum(-1, keepdim=True)
        color = self.base.color(points, normals, directions)
        return color + self.strength * torch.exp(-squared / self.width**2) * (1 - color)
