"""Bodies that twist and bend: smooth invertible maps of space between a straight body and where it is.

A ray is no straight line in a bent body's frame and may cross its surface several times, so crossings are searched:
an interval of the ray is left out only where the shape's excess proves that it holds none, the others are halved until
they are below rounding. What can be missed is a chord shorter than the last interval, `RESOLUTION` times the part of
the ray near the body: the optical depth is off by at most its density times that, 1e-10 for a density of 1000.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from dnerf.core.rays import Rays, parts_of
from dnerf.scenes.motions import Motion, Wave
from dnerf.scenes.poses import Pose
from dnerf.scenes.shapes import Ball, Shape, Vector

FIRST_LEVEL, LAST_LEVEL = 5, 43
"""The search begins with 2^5 intervals of a ray and ends with 2^43 of them (those that may hold a crossing)."""
RESOLUTION = 2.0**-LAST_LEVEL


@dataclass(frozen=True, kw_only=True)
class WarpedPose(Pose):
    """A pose after a warp of the body's own space: world point = pose(warp(local point))."""

    num_pieces: ClassVar[int] = 12

    warp: "Warp"  # the motion that says how space is warped
    amount: Tensor  # (...,) how much, in the warp's unit

    def to_world(self, points: Tensor) -> Tensor:
        return super().to_world(self.warp.bend(points, self.amount))

    def to_local(self, points: Tensor) -> Tensor:
        return self.warp.bend(super().to_local(points), -self.amount)

    @torch.no_grad()
    def spans(self, shape: Shape, rays: Rays) -> tuple[Tensor, Tensor]:
        """Crossings by search, in float64, see the module's text and `Pose.spans`."""
        dtype, num_rays = rays.origins.dtype, len(rays)
        exact, rays = self.map(Tensor.double), rays.to(torch.float64)
        radius = self.warp.reach(shape)
        straight = Pose(exact.rotation, exact.translation, exact.scale, exact.presence)
        low, high = Ball(radius).intersect(*straight.local_lines(rays))
        rays = replace(rays, near=torch.maximum(low, rays.near), far=torch.minimum(high, rays.far))
        rows = (rays.far > rays.near).nonzero()[:, 0]
        exact = exact.take(rows)
        slope = self.warp.stretch(exact.amount, radius) / exact.scale
        crossings = _Path(shape, exact, rays[rows], slope.expand(len(rows))).crossings()
        enter = torch.full((num_rays, crossings.shape[1] // 2), torch.inf, dtype=torch.float64, device=low.device)
        leave = -enter
        enter[rows], leave[rows] = crossings[:, 0::2], crossings[:, 1::2]
        leave[leave == torch.inf] = -torch.inf
        return enter.to(dtype), leave.to(dtype)


@dataclass(frozen=True)
class _Path:
    """H rays near a warped shape, whose excess along each changes by at most `slope` (H,) per unit."""

    shape: Shape
    pose: WarpedPose
    rays: Rays
    slope: Tensor

    def distances(self, rows: Tensor, shares: Tensor) -> Tensor:
        """Distances (M,) along rays `rows` (M,) at shares (M,) of their lengths."""
        return torch.lerp(self.rays.near[rows], self.rays.far[rows], shares)

    def excess(self, rows: Tensor, shares: Tensor) -> Tensor:
        """Excess (M,) of rays `rows` (M,) at shares (M,) of their lengths."""
        points = self.rays.origins[rows] + self.distances(rows, shares)[:, None] * self.rays.directions[rows]
        return self.shape.excess(self.pose.take(rows).to_local(points))

    def crossings(self) -> Tensor:
        """Sorted crossings (H, 2K), filled up with infinity; rays that begin or end inside cross at their ends."""
        num_rays, device = len(self.rays), self.slope.device
        ends = torch.arange(num_rays, device=device)
        reach = 0.5 * (self.rays.far - self.rays.near) * self.slope
        rows = ends.repeat_interleave(1 << FIRST_LEVEL)
        cells = torch.arange(1 << FIRST_LEVEL, device=device).repeat(num_rays)
        for level in range(FIRST_LEVEL, LAST_LEVEL + 1):
            width = 2.0**-level
            # The excess itself is known to rounding only.
            near_zero = self.excess(rows, (cells.double() + 0.5) * width).abs() <= width * reach[rows] + 1e-14
            rows, cells = rows[near_zero], cells[near_zero]
            if level < LAST_LEVEL:
                rows = rows.repeat_interleave(2)
                cells = (2 * cells[:, None] + torch.arange(2, device=device)).reshape(-1)
        # Shares are whole multiples of a power of two: neighbours have the same bits at the edge that they share.
        first, second = (self.excess(rows, (cells.double() + k) * RESOLUTION) for k in (0, 1))
        changes = (first <= 0) != (second <= 0)
        first, second = first[changes], second[changes]
        found_rows, shares = rows[changes], (cells[changes].double() + first / (first - second)) * RESOLUTION
        for share in (torch.zeros_like(reach), torch.ones_like(reach)):
            at_end = self.excess(ends, share) <= 0
            found_rows, shares = torch.cat([found_rows, ends[at_end]]), torch.cat([shares, share[at_end]])
        return _in_rows(found_rows, self.distances(found_rows, shares), num_rays)


def _in_rows(rows: Tensor, values: Tensor, num_rows: int) -> Tensor:
    """Values (M,) sorted within their rows (M,), as a table (num_rows, even) filled up with infinity."""
    order = values.argsort(stable=True)
    order = order[rows[order].argsort(stable=True)]
    rows, values = rows[order], values[order]
    counts = torch.bincount(rows, minlength=num_rows)
    columns = parts_of(counts)[1]
    width = 2 * ((int(counts.max()) + 1) // 2) if len(counts) else 0
    table = torch.full((num_rows, max(width, 2)), torch.inf, dtype=values.dtype, device=values.device)
    table[rows, columns] = values
    return table


@dataclass(frozen=True)
class Warp(Motion):
    """A motion that bends its body's space, without changing volumes.

    Args:
        amount: how much, as a function of time, in the warp's unit. The opposite amount undoes it.
    """

    amount: Wave

    def relative(self, times: Tensor) -> WarpedPose:
        return WarpedPose.at(times, warp=self, amount=self.amount(times))

    @abstractmethod
    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        """Points (..., 3) of the straight body, warped; `amount` (...,) may broadcast. `-amount` straightens them."""

    @abstractmethod
    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """Bound (...,) of how many times longer `bend` makes a short way within a ball about the origin."""

    @abstractmethod
    def reach(self, shape: Shape) -> float:
        """Radius of a ball about the origin that holds a shape however it is warped."""


def _corner(shape: Shape) -> Vector:
    x, y, z = (max(abs(a), abs(b)) for a, b in zip(*shape.bounds))
    return x, y, z


@dataclass(frozen=True)
class Twist(Warp):
    """Turns every cross-section about the z axis by amount * z; the amount is in radians per world unit."""

    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        cosine, sine = torch.cos(amount * z), torch.sin(amount * z)
        return torch.stack([cosine * x - sine * y, sine * x + cosine * y, z], dim=-1)

    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """A turn, and the change of the turn: 1 + |amount| radius."""
        return 1 + amount.abs() * radius

    def reach(self, shape: Shape) -> float:
        """Turns change no distance from the origin."""
        return math.hypot(*_corner(shape))


@dataclass(frozen=True)
class Bend(Warp):
    """Shifts every cross-section along x by amount * z^2: a rod along z becomes an arc of a parabola.

    The amount is in 1 / world unit, half the curvature at the origin.
    """

    def bend(self, points: Tensor, amount: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        return torch.stack([x + amount * z * z, y, z], dim=-1)

    def stretch(self, amount: Tensor, radius: float) -> Tensor:
        """A shear: 1 + 2 |amount| radius."""
        return 1 + 2 * amount.abs() * radius

    def reach(self, shape: Shape) -> float:
        """The corner of the shape, shifted as far as it ever is."""
        x, y, z = _corner(shape)
        most = abs(self.amount.mean) + sum(abs(amplitude) for amplitude, _, _ in self.amount.harmonics)
        return math.hypot(x + most * z * z, y, z)
