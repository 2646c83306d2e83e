"""Losses about the motion of flows, each optional: smooth, slow to change, volume-keeping, cycle-consistent.

As in `dnerf.motion_losses`, they look at some of a batch's own samples, weighted by their share in the picture, and
derivatives in space and time are finite differences.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

from dnerf.checks import check_positive
from dnerf.deformations import Flow, LatticeFlow, SkippingFlow
from dnerf.fields import DeformedField
from dnerf.motion_losses import DeformationLoss, MotionPoints, axis_steps
from dnerf.renderer import Renderer


class FlowLoss(DeformationLoss):
    """A term about the motion of a flow.

    Args:
        weight: factor of the term.
        num_points: see `DeformationLoss`.

    Raises:
        ValueError: as `DeformationLoss`, and when used, for a renderer whose deformation is no flow.
    """

    def _subject(self, renderer: Renderer) -> Flow:
        deformation = renderer.field.deformation if isinstance(renderer.field, DeformedField) else None
        if isinstance(deformation, LatticeFlow | SkippingFlow):
            deformation = deformation.flow
        if not isinstance(deformation, Flow):
            raise ValueError(
                f"{type(self).__name__} needs a renderer whose deformation is a flow, got {type(deformation).__name__}"
            )
        return deformation


class SmoothVelocityLoss(FlowLoss):
    """Squared spatial change of the velocity, |grad v|^2 = sum_ij (dv_i / dx_j)^2, in 1 / time^2.

    Args:
        weight: factor of the term.
        num_points: see `DeformationLoss`.
        distance: of the forward differences, in world units.
    """

    def __init__(self, weight: float = 1e-3, num_points: int = 1024, *, distance: float = 0.02) -> None:
        super().__init__(weight, num_points)
        check_positive("distance", distance)
        self.distance = distance

    def penalty(self, flow: Flow, points: MotionPoints) -> Tensor:
        """Squared Frobenius norm of the velocity's gradient, summed over a chain's flows."""
        steps = axis_steps(points.positions, self.distance)
        total = torch.zeros_like(points.times)
        for velocities in _around(flow, points, torch.cat([torch.zeros_like(steps[:1]), steps])):
            changes = (velocities[1:] - velocities[0]) / self.distance
            total = total + changes.square().sum((0, -1))
        return total


class DivergenceLoss(FlowLoss):
    """Squared divergence of the velocity, (div v)^2 in 1 / time^2: matter should keep its volume.

    Args:
        weight: factor of the term.
        num_points: see `DeformationLoss`.
        distance: half the span of the central differences, in world units.
    """

    def __init__(self, weight: float = 1e-4, num_points: int = 1024, *, distance: float = 0.02) -> None:
        super().__init__(weight, num_points)
        check_positive("distance", distance)
        self.distance = distance

    def penalty(self, flow: Flow, points: MotionPoints) -> Tensor:
        """Squared trace of the velocity's gradient; of a chain's, which may compress and expand in turn, the sum."""
        steps = axis_steps(points.positions, self.distance)
        total = torch.zeros_like(points.times)
        for velocities in _around(flow, points, torch.cat([steps, -steps])):
            ahead, behind = velocities.chunk(2)
            total = total + (ahead - behind).diagonal(dim1=0, dim2=2).sum(-1) / (2 * self.distance)
        return total.square()


class AccelerationLoss(FlowLoss):
    """Squared acceleration of matter along its track, |d^2 x / dt^2|^2 in world units^2 / time^4.

    Central differences of where one canonical point is at three times, so it is the acceleration of material points
    whatever the flow's clock is.

    Args:
        weight: factor of the term.
        num_points: see `DeformationLoss`.
        interval: between the three times, in (0, 0.5].
    """

    def __init__(self, weight: float = 1e-5, num_points: int = 512, *, interval: float = 0.02) -> None:
        super().__init__(weight, num_points)
        check_positive("interval", interval)
        if interval > 0.5:
            raise ValueError(f"interval must be in (0, 0.5], got {interval}")
        self.interval = interval

    def penalty(self, flow: Flow, points: MotionPoints) -> Tensor:
        """Squared second difference of the track."""
        canonical = flow(points.positions, points.times)
        middle = points.times.clamp(self.interval, 1 - self.interval)
        moments = torch.cat([middle - self.interval, middle, middle + self.interval])
        before, here, after = flow.reverse(canonical.repeat(3, 1), moments).chunk(3)
        return (before - 2 * here + after).square().sum(-1) / self.interval**4


class CycleConsistencyLoss(FlowLoss):
    """Squared distance between points and where they come back to, world -> canonical -> world, in world units^2.

    Zero for an exact flow: it penalises fields that the solver's few steps cannot follow.

    Args:
        weight: factor of the term.
        num_points: see `DeformationLoss`.
    """

    def __init__(self, weight: float = 1.0, num_points: int = 1024) -> None:
        super().__init__(weight, num_points)

    def penalty(self, flow: Flow, points: MotionPoints) -> Tensor:
        """Squared distance after the round trip by the uncorrected inverse."""
        back = flow.reverse(flow(points.positions, points.times), points.times)
        return (back - points.positions).square().sum(-1)


def _around(flow: Flow, points: MotionPoints, steps: Tensor) -> Iterator[Tensor]:
    """Velocities (K, M, 3) of each flow of a chain, at the M points where they enter it, moved by K steps (K, 3)."""
    positions, links = points.positions, flow.links()
    for k in range(len(links)):
        if k:
            with torch.no_grad():
                positions = links[k - 1](positions, points.times)
        places = positions + steps[:, None]
        yield links[k].velocity(places, points.times.expand(places.shape[:-1]))
