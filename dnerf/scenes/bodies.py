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
        density = self.density / pose.scale**3 if self.conserves_mass else torch.full_like(pose.scale, self.density)
        return density if pose.presence is None else density * pose.presence

    def contains(self, pose: Pose, positions: Tensor) -> Tensor:
        """Whether world positions (..., 3) lie inside, (...,) bool; never while the body is not there."""
        inside = self.shape.contains(pose.to_local(positions))
        return inside if pose.presence is None else inside & (pose.presence > 0)

    def color(self, points: Tensor, directions: Tensor) -> Tensor:
        """Colour (..., 3) at points and for unit viewing directions (..., 3) in the body's frame."""
        return self.texture.color(points, self.shape.normals(points), directions)

    def spans(
        self, pose: Pose, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Distances (R, K) at which rays (R, 3) in the world enter and leave, see `Pose.spans`."""
        return pose.spans(self.shape, origins, directions, near, far)

    def breaks(self, pose: Pose, origins: Tensor, directions: Tensor) -> Tensor:
        """Distances (R, M) at which the colour along rays (R, 3) in the world jumps."""
        return self.texture.breaks(*pose.local_lines(origins, directions))
