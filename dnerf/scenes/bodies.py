"""A body: a shape full of matter, coloured, moving."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.scenes.motions import Fixed, Motion
from dnerf.scenes.poses import Pose
from dnerf.scenes.shapes import Shape
from dnerf.scenes.textures import Texture


@dataclass(frozen=True)
class Body:
    """A shape of constant density with a colour and a motion.

    Args:
        shape: in the body's frame.
        texture: in the body's frame.
        motion: of the body's frame.
        density: at scale 1, in 1 / world unit.
        conserves_mass: whether a body that grows by s gets thinner by s^3; otherwise its density stays.

    Raises:
        ValueError: if the density is not positive.
    """

    shape: Shape
    texture: Texture
    motion: Motion = field(default_factory=Fixed)
    density: float = 80.0
    conserves_mass: bool = False

    def __post_init__(self) -> None:
        check_positive("density", self.density)

    def density_at(self, pose: Pose) -> Tensor:
        """Density inside, (...,) like the pose, in 1 / world unit."""
        if self.conserves_mass:
            return self.density / pose.scale**3
        return torch.full_like(pose.scale, self.density)

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Colour (..., 3) at points and for unit viewing directions (..., 3) in the body's frame."""
        return self.texture.color(points, self.shape.normals(points), directions)

    def intersect(self, pose: Pose, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distances (R,) at which rays (R, 3) in the world enter and leave; `enter >= leave` if they miss."""
        return self.shape.intersect(*_local_lines(pose, origins, directions))

    def breaks(self, pose: Pose, origins: Tensor, directions: Tensor) -> Tensor:
        """Distances (R, M) at which the colour along rays (R, 3) in the world jumps."""
        return self.texture.breaks(*_local_lines(pose, origins, directions))


def _local_lines(pose: Pose, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Lines in the body's frame, run through at the same distances as in the world."""
    return pose.to_local(origins), pose.directions_to_local(directions) / pose.scale[..., None]
