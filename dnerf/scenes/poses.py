"""Similarity poses: rotation, translation and uniform scale between a body's frame and the world."""

from dataclasses import dataclass

import torch
from torch import Tensor


def rotate(matrices: Tensor, vectors: Tensor) -> Tensor:
    """Apply matrices (..., 3, 3) to vectors (..., 3), broadcasting.

    Three fused products: no (..., 3, 3) temporary where one matrix serves many vectors.
    """
    x, y, z = vectors.unsqueeze(-2).unbind(-1)
    return x * matrices[..., 0] + y * matrices[..., 1] + z * matrices[..., 2]


@dataclass(frozen=True)
class Pose:
    """World point = scale * rotation @ local point + translation.

    Args:
        rotation: (..., 3, 3).
        translation: (..., 3) in world units.
        scale: (...,) > 0.
    """

    rotation: Tensor
    translation: Tensor
    scale: Tensor

    @classmethod
    def identity(cls, times: Tensor) -> "Pose":
        """The pose that changes nothing, one for each time (...,)."""
        eye = torch.eye(3, dtype=times.dtype, device=times.device).expand(*times.shape, 3, 3)
        return cls(eye, torch.zeros_like(eye[..., 0]), torch.ones_like(times))

    def take(self, indices: Tensor) -> "Pose":
        """Poses of the given items; a single pose (1,) serves all items and stays single."""
        if len(self.scale) == 1:
            return self
        return Pose(self.rotation[indices], self.translation[indices], self.scale[indices])

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
        return Pose(self.rotation @ child.rotation, self.to_world(child.translation), self.scale * child.scale)
