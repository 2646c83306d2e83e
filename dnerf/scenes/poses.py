"""Similarity poses: rotation, translation and uniform scale between a body's frame and the world."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from dnerf.core.geometry import skew
from dnerf.core.rays import Rays
from dnerf.scenes.shapes import Shape, Vector, constant


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Apply matrices (..., 3, 3) to vectors (..., 3), broadcasting.

    Three fused products: no (..., 3, 3) temporary where one matrix serves many vectors.
    """
    x, y, z = vectors.unsqueeze(-2).unbind(-1)
    return x * matrices[..., 0] + y * matrices[..., 1] + z * matrices[..., 2]


def turn(axis: Vector, angles: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about a fixed axis of any positive length by angles (...,) in radians.

    Rodrigues with the axis known: no division by the angle, a tenth of the work of `so3_exp`.
    """
    direction = constant(axis, angles)
    direction = direction / direction.norm()
    eye = torch.eye(3, dtype=angles.dtype, device=angles.device)
    sine, versine = torch.sin(angles)[..., None, None], 2 * torch.sin(0.5 * angles)[..., None, None] ** 2
    return eye + sine * skew(direction) + versine * (direction[:, None] * direction - eye)


@dataclass(frozen=True)
class Pose:
    """World point = scale * rotation @ local point + translation."""

    num_pieces: ClassVar[int] = 1
    """Equal parts of a body along a ray in each of which its colour is smooth enough for one Gauss rule."""

    rotation: Tensor  # (..., 3, 3)
    translation: Tensor  # (..., 3) in world units
    scale: Tensor  # (...,) > 0
    presence: Tensor  # (...,) 1 while the body is there, 0 while it is not

    @classmethod
    def at(cls, times: Tensor, **parts: Any) -> Self:
        """One pose for each time (...,), which changes nothing except by the given parts."""
        eye = torch.eye(3, dtype=times.dtype, device=times.device).expand(*times.shape, 3, 3)
        one = torch.ones_like(times)
        same = {"rotation": eye, "translation": torch.zeros_like(eye[..., 0]), "scale": one, "presence": one}
        return cls(**(same | parts))

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The pose with a function applied to each tensor."""
        return replace(self, **{n: function(value) for n, value in vars(self).items() if isinstance(value, Tensor)})

    def take(self, indices: Tensor) -> Self:
        """Poses of the given items; a single pose (1,) serves all items and stays single."""
        return self if len(self.scale) == 1 else self.map(lambda value: value[indices])

    def to_world(self, points: Tensor) -> Tensor:
        """Local points (..., 3) to the world."""
        return self.scale[..., None] * rotate(self.rotation, points) + self.translation

    def to_local(self, points: Tensor) -> Tensor:
        """World points (..., 3) to the body's frame."""
        return self.directions_to_local(points - self.translation) / self.scale[..., None]

    def directions_to_local(self, directions: Tensor) -> Tensor:
        """World directions (..., 3) to the body's frame, their length kept."""
        return rotate(self.rotation.mT, directions)

    def then(self, child: "Pose") -> "Pose":
        """Pose of a frame that is given relative to this one."""
        columns = [rotate(self.rotation, child.rotation[..., i]) for i in range(3)]
        return replace(
            child, rotation=torch.stack(columns, -1), translation=self.to_world(child.translation),
            scale=self.scale * child.scale, presence=self.presence * child.presence,
        )  # fmt: skip

    def local_lines(self, rays: Rays) -> tuple[Tensor, Tensor]:
        """Origins and directions (R, 3) of rays in the body's frame, run through at the same distances."""
        return self.to_local(rays.origins), self.directions_to_local(rays.directions) / self.scale[..., None]

    def spans(self, shape: Shape, rays: Rays) -> tuple[Tensor, Tensor]:
        """Where rays are inside a shape: distances (R, K) at which they enter and leave, `enter >= leave` for none.

        Spans outside a ray's near and far may be missing. Shapes are convex: K = 1 unless the frame is bent.
        """
        enter, leave = shape.intersect(*self.local_lines(rays))
        return enter[:, None], leave[:, None]
