"""The map from a data set's own units to the world that models live in, and back.

In the world the box of what is modelled stands at the origin, its longest side is `LONGEST_SIDE`, and z is up.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_shape
from dnerf.core.geometry import check_last_axis, cube_corners

LONGEST_SIDE = 2.5  # of the box, in world units: every length in conf/ is one of this world

Vector = tuple[float, float, float]
AXES: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Similarity:
    """`world = scale * rotation (own - center)`: own are the data set's units and axes.

    Raises:
        ValueError: unless the scale is positive and finite, the rotation proper (to 1e-6) and the center finite.
    """

    scale: float = 1.0  # world units in one of the data set's
    rotation: tuple[Vector, Vector, Vector] = AXES  # rows are the world's axes
    center: Vector = (0.0, 0.0, 0.0)  # where the world's origin lies, in the data set's units

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise ValueError(f"scale must be positive and finite, got {self.scale}")
        turn = torch.tensor(self.rotation, dtype=torch.float64)
        check_shape("rotation", turn, (3, 3))
        deviation = (turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max()
        if not (deviation <= 1e-6 and torch.linalg.det(turn) > 0):
            raise ValueError(f"rotation must be orthonormal and right-handed, got {self.rotation}")
        if len(self.center) != 3 or not all(map(math.isfinite, self.center)):
            raise ValueError(f"center must be three finite numbers, got {self.center}")

    @classmethod
    def of_box(cls, box: Sequence[Sequence[float]] | Tensor, up: Sequence[float] = AXES[2]) -> "Similarity":
        """The one that moves the middle of a box (2, 3), in the data set's units, to the origin, turns up to z and
        makes the longest side `LONGEST_SIDE`. Lengths are those along the turned axes; see `box_to_world`."""
        corners = torch.as_tensor(box).double()
        check_shape("box", corners, (2, 3))
        if not bool(corners.isfinite().all()) or not bool((corners[1] > corners[0]).all()):
            raise ValueError(f"box must have finite corners, low < high on every axis, got {corners.tolist()}")
        x, y, z = corners.mean(0).tolist()
        center: Vector = (x, y, z)
        turned = cls(1.0, upright(up), center)
        low, high = turned.box_to_world(corners)
        return cls(LONGEST_SIDE / float((high - low).max()), turned.rotation, center)

    def positions_to_world(self, positions: Tensor) -> Tensor:
        """Positions (..., 3) in the data set's units -> (..., 3) float64 in world units."""
        check_last_axis("positions", positions, 3)
        return self.scale * self._turned(positions.double() - self._center(positions))

    def positions_from_world(self, positions: Tensor) -> Tensor:
        """Positions (..., 3) in world units -> (..., 3) float64 in the data set's."""
        check_last_axis("positions", positions, 3)
        rotation = torch.tensor(self.rotation, dtype=torch.float64, device=positions.device)
        return (positions.double() / self.scale) @ rotation + self._center(positions)

    def poses_to_world(self, poses: Tensor) -> Tensor:
        """Camera-to-world poses (..., 4, 4) in the data set's units -> (..., 4, 4) float64 in world units."""
        result = poses.double().clone()
        result[..., :3, :3] = self._turned(poses[..., :3, :3].double().mT).mT
        result[..., :3, 3] = self.positions_to_world(poses[..., :3, 3])
        return result

    def poses_from_world(self, poses: Tensor) -> Tensor:
        """Camera-to-world poses (..., 4, 4) in world units -> (..., 4, 4) float64 in the data set's."""
        result = poses.double().clone()
        rotation = torch.tensor(self.rotation, dtype=torch.float64, device=poses.device)
        result[..., :3, :3] = rotation.T @ poses[..., :3, :3].double()
        result[..., :3, 3] = self.positions_from_world(poses[..., :3, 3])
        return result

    def box_to_world(self, box: Sequence[Sequence[float]] | Tensor) -> Tensor:
        """The smallest box (2, 3) float64 in world units that holds a box (2, 3) in the data set's."""
        return _around(self.positions_to_world(_corners(box)))

    def box_from_world(self, box: Sequence[Sequence[float]] | Tensor) -> Tensor:
        """The smallest box (2, 3) float64 in the data set's units that holds a box (2, 3) in world units."""
        return _around(self.positions_from_world(_corners(box)))

    def _turned(self, vectors: Tensor) -> Tensor:
        # The identity is left out: a product with it would turn -0 to 0 and infinity to NaN.
        if self.rotation == AXES:
            return vectors
        return vectors @ torch.tensor(self.rotation, dtype=torch.float64, device=vectors.device).T

    def _center(self, like: Tensor) -> Tensor:
        return torch.tensor(self.center, dtype=torch.float64, device=like.device)


IDENTITY = Similarity()


@dataclass(frozen=True)
class Clock:
    """The map from a data set's own times to [0, 1]: `(own - start) / length`."""

    start: float = 0.0  # own time at 0
    length: float = 1.0  # own time from 0 to 1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and 0 < self.length < math.inf):
            raise ValueError(f"start and length must be finite, length positive, got {self.start} and {self.length}")

    @classmethod
    def of(cls, times: Sequence[float]) -> "Clock":
        """The one of a data set's times: [0, 1] is kept, others begin at 0 and end at 1."""
        first, last = min(times), max(times)
        if first >= 0 and last <= 1:
            return cls()
        return cls(first, last - first if last > first else 1.0)

    def normalised(self, own: float) -> float:
        """A time of the data set's clock as one in which the data set's last from 0 to 1."""
        return (own - self.start) / self.length

    def own(self, time: float) -> float:
        """A time in [0, 1] by the data set's clock."""
        return self.start + time * self.length


def upright(up: Sequence[float]) -> tuple[Vector, Vector, Vector]:
    """The rotation by the least angle that turns a direction to +z; about x where it points down.

    Raises:
        ValueError: if the direction has no length.
    """
    x, y, z = (float(value) for value in up)
    length = math.sqrt(x * x + y * y + z * z)
    if not 0 < length < math.inf:
        raise ValueError(f"up must be a direction, got {list(up)}")
    x, y, z = x / length, y / length, z / length
    if 1 + z < 1e-12:
        return (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
    if x == y == 0:
        return AXES
    # Rodrigues' formula about up x z: R = I + [v] + [v]^2 / (1 + z), v = (y, -x, 0).
    share = 1 / (1 + z)
    return (1 - x * x * share, -x * y * share, -x), (-x * y * share, 1 - y * y * share, -y), (x, y, z)


def _corners(box: Sequence[Sequence[float]] | Tensor) -> Tensor:
    corners = torch.as_tensor(box).double()
    check_shape("box", corners, (2, 3))
    return torch.lerp(corners[0], corners[1], cube_corners(corners.device).double())


def _around(positions: Tensor) -> Tensor:
    return torch.stack([positions.amin(0), positions.amax(0)])
