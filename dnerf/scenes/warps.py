"""Bodies that twist and bend: smooth invertible maps of space between a straight body and where it is.

A ray is no straight line in a bent body's frame and may cross its surface several times, so crossings are searched:
an interval of the ray is left out only where the shape's excess proves that it holds none, the others are halved until
they are below rounding. What can be missed is a chord shorter than the last interval, `RESOLUTION` times the part of
the ray near the body: the optical depth is off by at most its density times that, 1e-10 for a density of 1000.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from dnerf.scenes.motions import Motion, Wave
from dnerf.scenes.poses import Pose
from dnerf.scenes.shapes import Ball, Shape

FIRST_LEVEL, LAST_LEVEL = 5, 43
"""The search begins with 2^5 intervals of a ray and ends with 2^43 of them (those that may hold a crossing)."""
RESOLUTION = 2.0**-LAST_LEVEL


@dataclass(frozen=True)
class WarpedPose(Pose):
    """A pose after a warp of the body's own space: world point = pose(warp(local point)).

    Args:
        warp: the motion that says how space is warped.
        amount: (...,) how much, in the warp's unit.
    """

    num_pieces: ClassVar[int] = 12

    warp: "Warp | None" = None
    amount: Tensor | None = None

    def take(self, indices: Tensor) -> "WarpedPose":
        """Poses of the given items, see `Pose.take`."""
        if len(self.scale) == 1:
            return self
        assert self.amount is not None
        taken = super().take(indices)
        assert isinstance(taken, WarpedPose)
        return replace(taken, amount=self.amount[indices])

    def to_world(self, points: Tensor) -> Tensor:
        """Local points (..., 3) to the world."""
        assert self.warp is not None
        assert self.amount is not None
        return super().to_world(self.warp.bend(points, self.amount))

    def to_local(self, points: Tensor) -> Tensor:
        """World points (..., 3) to the straight body's frame."""
        assert self.warp is not None
        assert self.amount is not None
        return self.warp.straighten(super().to_local(points), self.amount)

    @torch.no_grad()
    def spans(
        self, shape: Shape, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Crossings by search, in float64, see the module's text and `Pose.spans`."""
        assert self.warp is not None
        assert self.amount is not None
        dtype, num_rays = origins.dtype, len(origins)
        exact = replace(self, **{n: getattr(self, n).double() for n in ("rotation", "translation", "scale", "amount")})
        origins, directions = origins.double(), directions.double()
        radius = self.warp.reach(shape)
        plain = Pose(exact.rotation, exact.translation, exact.scale)
        low, high = Ball(radius).intersect(*plain.local_lines(origins, directions))
        low, high = torch.maximum(low, near.double()), torch.minimum(high, far.double())
        rows = (high > low).nonzero()[:, 0]
        exact, low, high = exact.take(rows), low[rows], high[rows]
        assert exact.amount is not None
        slope = self.warp.stretch(exact.amount, radius) / exact.scale
        path = _Path(shape, exact, origins[rows], directions[rows], low, high, slope)
        crossings = path.crossings()
        enter = torch.full((num_rays, crossings.shape[1] // 2), torch.inf, dtype=torch.float64, device=origins.device)
        leave = -enter
        enter[rows], leave[rows] = crossings[:, 0::2], crossings[:, 1::2]
        leave[leave == torch.inf] = -torch.inf
        return enter.to(dtype), leave.to(dtype)


@dataclass(frozen=True)
class _Path:
    """Rays (H,) between `low` and `high` past a warped shape, whose excess changes by at most `slope` per unit."""

    shape: Shape
    pose: WarpedPose
    origins: Tensor
    directions: Tensor
    low: Tensor
    high: Tensor
    slope: Tensor

    def excess(self, rows: Tensor, shares: Tensor) -> Tensor:
        """Excess (M,) of rays `rows` (M,) at shares (M,) of their lengths."""
        distances = torch.lerp(self.low[rows], self.high[rows], shares)
        points = self.origins[rows] + distances[:, None] * self.directions[rows]
        return self.shape.excess(self.pose.take(rows).to_local(points))

    def crossings(self) -> Tensor:
        """Sorted crossings (H, 2K), filled up with infinity; rays that begin or end inside cross at their ends."""
        num_rays, device = len(self.low), self.low.device
        count = 1 << FIRST_LEVEL
        rows = torch.arange(num_rays, device=device).repeat_interleave(count)
        cells = torch.arange(count, device=device).repeat(num_rays)
        slope = self.slope.expand(num_rays)
        for level in range(FIRST_LEVEL, LAST_LEVEL + 1):
            width = 2.0**-level
            reach = 0.5 * width * (self.high - self.low) * slope
            # The excess itself is known to rounding only.
            near_zero = self.excess(rows, (cells.double() + 0.5) * width).abs() <= reach[rows] + 1e-14
            rows, cells = rows[near_zero], cells[near_zero]
            if level < LAST_LEVEL:
                rows = rows.repeat_interleave(2)
                cells = (2 * cells[:, None] + torch.arange(2, device=device)).reshape(-1)
        # Shares are whole multiples of a power of two: neighbours have the same bits at the edge that they share.
        first, second = (self.excess(rows, (cells.double() + k) * RESOLUTION) for k in (0, 1))
        changes = (first <= 0) != (second <= 0)
        first, second = first[changes], second[changes]
        found_rows, shares = rows[changes], (cells[changes].double() + first / (first - second)) * RESOLUTION
        ends = torch.arange(num_rays, device=device)
        for share in (0.0, 1.0):
            at_end = self.excess(ends, torch.full_like(self.low, share)) <= 0
            found_rows = torch.cat([found_rows, ends[at_end]])
            shares = torch.cat([shares, torch.full_like(self.low[at_end], share)])
        return _in_rows(found_rows, torch.lerp(self.low[found_rows], self.high[found_rows], shares), num_rays)


def _in_rows(rows: Tensor, values: Tensor, num_rows: int) -> Tensor:
    """Values (M,) sorted within their rows (M,), as a table (num_rows, even) filled up with infinity."""
    order = values.argsort(stable=True)
    order = order[rows[order].argsort(stable=True)]
    rows, values = rows[order], values[order]
    counts = torch.bincount(rows, minlength=num_rows)
    columns = torch.arange(len(rows), device=rows.device) - (counts.cumsum(0) - counts)[rows]
    width = 2 * ((int(counts.max()) + 1) // 2) if len(counts) else 0
    table = torch.full((num_rows, max(width, 2)), torch.inf, dtype=values.dtype, device=values.device)
    table[rows, columns] = values
    return table


class Warp(Motion):
    """A motion that bends its body's space, without changing volumes."""

    amount: Wave

    def relative(self, times: Tensor) -> WarpedPose:
        """The warped frame at times (...,)."""
        identity = Pose.identity(times)
        return WarpedPose(
            identity.rotation, identity.translation, identity.scale, warp=self, amount=self.amount(times)
        )  # fmt: skip

    @abstractmethod
    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        """Points (..., 3) of the straight body, warped; `amount` (...,) may broadcast."""

    @abstractmethod
    def straighten(self, points: Tensor, amount: Tensor) -> Tensor:
        """The inverse of `bend`."""

    @abstractmethod
    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """Bound (...,) of how many times longer `straighten` makes a short way within a ball about the origin."""

    @abstractmethod
    def reach(self, shape: Shape) -> float:
        """Radius of a ball about the origin that holds a shape however it is warped."""

    def _most(self) -> float:
        """Bound of the amount at any time."""
        return abs(self.amount.mean) + sum(abs(a) for a, _, _ in self.amount.harmonics)


def _corner(shape: Shape) -> tuple[float, float, float]:
    x, y, z = (max(abs(a), abs(b)) for a, b in zip(*shape.bounds))
    return x, y, z


@dataclass(frozen=True)
class Twist(Warp):
    """Turns every cross-section about the z axis, by an angle that grows along it.

    Args:
        amount: radians per world unit of z, as a function of time.
        parent: motion of the frame; the world if None.
    """

    amount: Wave = field(default_factory=Wave)
    parent: Motion | None = None

    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        """Turn by amount * z."""
        x, y, z = points.unbind(-1)
        cosine, sine = torch.cos(amount * z), torch.sin(amount * z)
        return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1)

    def straighten(self, points: Tensor, amount: Tensor) -> Tensor:
        """Turn back."""
        return self.bend(points, -amount)

    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """A turn, and the change of the turn: 1 + |amount| radius."""
        return 1 + amount.abs() * radius

    def reach(self, shape: Shape) -> float:
        """Turns change no distance from the origin."""
        return math.hypot(*_corner(shape))


@dataclass(frozen=True)
class Bend(Warp):
    """Shifts every cross-section along x by amount * z^2: a rod along z becomes an arc of a parabola.

    Args:
        amount: 1 / world unit, half the curvature at the origin, as a function of time.
        parent: motion of the frame; the world if None.
    """

    amount: Wave = field(default_factory=Wave)
    parent: Motion | None = None

    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        """Shift along x."""
        x, y, z = points.unbind(-1)
        return torch.stack([x + amount * z * z, y, z], dim=-1)

    def straighten(self, points: Tensor, amount: Tensor) -> Tensor:
        """Shift back."""
        return self.bend(points, -amount)

    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """A shear: 1 + 2 |amount| radius."""
        return 1 + 2 * amount.abs() * radius

    def reach(self, shape: Shape) -> float:
        """The corner of the shape, shifted as far as it ever is."""
        x, y, z = _corner(shape)
        return math.hypot(x + self._most() * z * z, y, z)
