"""Similarity poses: rotation, translation and uniform scale between a body's frame and the world."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from dnerf.geometry import skew

if TYPE_CHECKING:
    from dnerf.scenes.shapes import Shape


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Apply matrices (..., 3, 3) to vectors (..., 3), broadcasting.

    Three fused products: no (..., 3, 3) temporary where one matrix serves many vectors.
    """
    x, y, z = vectors.unsqueeze(-2).unbind(-1)
    return x * matrices[..., 0] + y * matrices[..., 1] + z * matrices[..., 2]


def turn(axis: tuple[float, float, float], angles: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) about a fixed axis of any positive length by angles (...,) in radians.

    Rodrigues with the axis known: no division by the angle, a tenth of the work of `so3_exp`.
    """
    direction = torch.tensor(axis, dtype=angles.dtype, device=angles.device)
    direction = direction / direction.norm()
    eye = torch.eye(3, dtype=angles.dtype, device=angles.device)
    sine, versine = torch.sin(angles)[..., None, None], 2 * torch.sin(0.5 * angles)[..., None, None] ** 2
    return eye + sine * skew(direction) + versine * (direction[:, None] * direction - eye)


@dataclass(frozen=True)
class Pose:
    """World point = scale * rotation @ local point + translation.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) in world units.
        scale: (...,) > 0.
        presence: (...,) 1 while the body is there, 0 while it is not; None for always.
    """

    num_pieces: ClassVar[int] = 1
    """Equal parts of a body along a ray in each of which its colour is smooth enough for one Gauss rule."""

    rotation: Tensor
    translation: Tensor
    scale: Tensor
    presence: Tensor | None = None

    @classmethod
    def identity(cls, times: Tensor) -> "Pose":
        """The pose that changes nothing, one for each time (...,)."""
        eye = torch.eye(3, dtype=times.dtype, device=times.device).expand(*times.shape, 3, 3)
        return cls(eye, torch.zeros_like(eye[..., 0]), torch.ones_like(times))

    def take(self, indices: Tensor) -> "Pose":
        """Poses of the given items; a single pose (1,) serves all items and stays single."""
        if len(self.scale) == 1:
            return self
        presence = None if self.presence is None else self.presence[indices]
        return replace(
            self,
            rotation=self.rotation[indices],
            translation=self.translation[indices],
            scale=self.scale[indices],
            presence=presence,
        )

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
        found = [p for p in (self.presence, child.presence) if p is not None]
        return replace(
            child,
            rotation=torch.stack(columns, -1),
            translation=self.to_world(child.translation),
            scale=self.scale * child.scale,
            presence=found[0] * found[-1] if found else None,
        )

    def local_lines(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Lines (R, 3) of the world in the body's frame, run through at the same distances."""
        return self.to_local(origins), self.directions_to_local(directions) / self.scale[..., None]

    def spans(
        self, shape: "Shape", origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Where rays are inside a shape: distances (R, K) at which they enter and leave, `enter >= leave` for none.

        Args:
            shape: in the body's frame; convex, so that K = 1 unless the frame is bent.
            origins: (R, 3) in the world.
            directions: (R, 3), unit norm.
            near: (R,) distances before which nothing is asked.
            far: (R,) distances after which nothing is asked.
        """
        enter, leave = shape.intersect(*self.local_lines(origins, directions))
        return enter[:, None], leave[:, None]
