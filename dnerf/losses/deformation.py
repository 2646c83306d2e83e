"""Terms about motion, for any deformation: elastic, against folds, and constancy of what it carries.

They look at some of a batch's own samples, weighted by their share in the image: motion of empty space is free.
Derivatives in space are finite differences, since compiled kernels are differentiable once.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.core.compositing import Rendering
from dnerf.core.schedules import Schedule
from dnerf.deformations import unwrapped
from dnerf.fields import DeformedField
from dnerf.losses.base import Batch, Loss
from dnerf.rendering.renderer import Renderer

LEAST_STRETCH = 0.01
LEAST_DISTANCE = 1e-4  # world units, below which a displacement counts as none and has no gradient
GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class MotionPoints:
    """Samples of a batch at which motion is judged, without gradient."""

    positions: Tensor  # (M, 3) in world units
    canonical: Tensor  # (M, 3) where the deformation put them
    times: Tensor  # (M,)
    shares: Tensor  # (M,) summing to 1, to 0 if the image shows nothing


def deformed(model: Renderer, who: Loss) -> DeformedField:
    """The model's field, which has a deformation; ValueError, naming the term that needs one, if it has none."""
    if not isinstance(model.field, DeformedField):
        raise ValueError(f"{type(who).__name__} needs a deformed field, got {type(model.field).__name__}")
    return model.field


class DeformationLoss(Loss):
    """A term about a deformation or what it carries: the mean over points, weighted by their shares.

    Args:
        weight: factor of the term.
        num_points: at most so many samples of each batch are looked at, evenly spread over it.
        every: steps between its turns, see `Loss`.
        saturation: price, before `weight`, that no point exceeds, see `saturated`; None for none.

    Raises:
        ValueError: for a negative weight, no points, or a saturation that is not positive.
    """

    def __init__(
        self, weight: float | Schedule, num_points: int, *, every: int, saturation: float | None = None
    ) -> None:
        super().__init__(weight, every=every)
        check_positive("num_points", num_points)
        if saturation is not None:
            check_positive("saturation", saturation)
        self.num_points, self.saturation = num_points, saturation

    def check(self, model: Renderer) -> None:
        """Needs a deformed field."""
        deformed(model, self)

    def forward(self, rendering: Rendering, batch: Batch, model: Renderer) -> Tensor:
        """The mean of what is wrong at points of the batch."""
        points = self._points(rendering)
        return (points.shares * saturated(self._penalty(deformed(model, self), points), self.saturation)).sum()

    @abstractmethod
    def _penalty(self, field: DeformedField, points: MotionPoints) -> Tensor:
        """What is wrong at each point, (M,)."""

    def _points(self, rendering: Rendering) -> MotionPoints:
        assert rendering.output is not None
        assert rendering.weights is not None
        extras = rendering.output.extras
        chosen = spread_numbers(extras["times"].shape, self.num_points, extras["times"].device)
        weights = rendering.weights.detach().reshape(-1)[chosen]
        return MotionPoints(
            positions=extras["positions"].detach().reshape(-1, 3)[chosen],
            canonical=extras["canonical_positions"].detach().reshape(-1, 3)[chosen],
            times=extras["times"].reshape(-1)[chosen],
            shares=weights / weights.sum().clamp(min=torch.finfo(weights.dtype).tiny),
        )


class ElasticLoss(DeformationLoss):
    """Squared logarithm of how much the deformation stretches: what moves should keep its lengths and not fold.

    For a deformation D: `(log |D(x + h u, t) - D(x, t)| / h)^2`, u another unit direction at each point. It is zero
    for rigid motion and grows towards a collapsed direction, which a map that folds has to pass through. With a
    saturation it is robust: what lies between bodies that part, or where one meets another, may stretch at that price.

    Source: the elastic regularisation of Nerfies (arXiv 2011.12948) eq. 6, robust, as there, with `saturation`;
    deviation: the stretch along one direction a point, from finite differences, instead of all singular values of the
    Jacobian.

    Args:
        weight, num_points, every, saturation: see `DeformationLoss`.
        distance: of the differences, h, in world units.

    Raises:
        ValueError: as `DeformationLoss`, and for a distance that is not positive.
    """

    def __init__(
        self, weight: float | Schedule = 1e-3, num_points: int = 512, *, distance: float = 0.02,
        saturation: float | None = None, every: int = 2,
    ) -> None:  # fmt: skip
        super().__init__(weight, num_points, every=every, saturation=saturation)
        check_positive("distance", distance)
        self.distance = distance

    def _penalty(self, field: DeformedField, points: MotionPoints) -> Tensor:
        """Squared logarithm of the stretch; of a collapsed direction as of a hundredth of its length."""
        steps = self.distance * spread_directions(points.positions)
        ends = torch.cat([points.positions, points.positions + steps])
        here, there = unwrapped(field.deformation)(ends, points.times.repeat(2)).chunk(2)
        squared = ((there - here) / self.distance).square().sum(-1)
        return (0.5 * torch.log(squared + LEAST_STRETCH**2)).square()


class RestLoss(DeformationLoss):
    """How far things move: `|D(x, t) - x|`, at the times of other rays as well as at a sample's own.

    Where several cameras look at several times, nothing says how a place looked at the times when none saw it. With
    this it looked as it did when it was seen, unless images say otherwise.

    Source: the price of the flow in Neural Scene Flow Fields (arXiv 2011.13084); deviation: other times.

    Args:
        weight, num_points, every: see `DeformationLoss`.
    """

    def __init__(self, weight: float | Schedule = 1e-2, num_points: int = 512, *, every: int = 2) -> None:
        super().__init__(weight, num_points, every=every)

    def _penalty(self, field: DeformedField, points: MotionPoints) -> Tensor:
        """Distances, half of them at the times of points half a batch away."""
        other = points.times.roll(len(points.times) // 2)
        is_own = torch.arange(len(other), device=other.device) % 2 == 0
        moved = unwrapped(field.deformation)(points.positions, torch.where(is_own, points.times, other))
        return (moved - points.positions).square().sum(-1).clamp(min=LEAST_DISTANCE**2).sqrt()


class JacobianDeterminantLoss(DeformationLoss):
    """Squared logarithm of how far the deformation falls short of a part of each volume: space must not fold.

    For a deformation D: `min(0, log (det (dD / dx) / limit))^2`, nothing where more than `limit` of a volume is left,
    and large before a map folds, which has to pass through a determinant of zero. A logarithm has no value beyond that:
    below `least` it goes on straight, so that what has folded is pulled back.

    Source: penalties of negative determinants in image registration (Kuang and Schmah 2019, there of -det above zero);
    deviation: it begins before anything folds, and the straight end.

    Args:
        weight, num_points, every: see `DeformationLoss`.
        limit: determinant from which on there is no price.
        distance: of the forward differences, in world units; folds begin small.
        least: determinant below which the logarithm goes on as its tangent.

    Raises:
        ValueError: as `DeformationLoss`, for a distance or a least determinant that is not positive, and for a limit
            that is not in [least, 1].
    """

    def __init__(
        self, weight: float | Schedule = 1e-2, num_points: int = 256, *, limit: float = 0.5, distance: float = 0.005,
        least: float = 0.1, every: int = 4,
    ) -> None:  # fmt: skip
        super().__init__(weight, num_points, every=every)
        check_positive("distance", distance)
        check_positive("least", least)
        if not least <= limit <= 1:
            raise ValueError(f"limit must be in [least, 1] = [{least}, 1], got {limit}")
        self.limit, self.distance, self.least = limit, distance, least

    def _penalty(self, field: DeformedField, points: MotionPoints) -> Tensor:
        """Squared logarithm of the determinant, of differences along the axes, to the limit where it is smaller."""
        steps = self.distance * torch.eye(3, dtype=points.positions.dtype, device=points.positions.device)
        places = points.positions + torch.cat([torch.zeros_like(steps[:1]), steps])[:, None]
        here, *there = unwrapped(field.deformation)(places, points.times.expand(places.shape[:-1])).unbind()
        x, y, z = ((end - here) / self.distance for end in there)
        determinant = (torch.linalg.cross(x, y) * z).sum(-1)
        logarithms = torch.log(determinant.clamp(min=self.least)) + (determinant / self.least - 1).clamp(max=0)
        return (logarithms - math.log(self.limit)).clamp(max=0).square()


class AppearanceConstancyLoss(DeformationLoss):
    """Squared change of what is carried along: of its opacity and colour, between a ray's time and another.

    For a canonical field that may change with time: `(a(t) - a(t'))^2 + color |rgb(t) - rgb(t')|^2` with a the opacity
    `1 - exp(-density length)`, t a sample's time and t' any other. What changes in canonical space can explain by
    itself whatever motion would, so motion is found only if change has a price. No gradient reaches the deformation.

    Args:
        weight, num_points, every: see `DeformationLoss`.
        length: of the intervals whose opacity is meant, in world units; over long ones it may grow denser or
            thinner, as long as it hides what lies behind.
        color: factor of changes of colour, >= 0; 0 for opacity alone.

    Raises:
        ValueError: as `DeformationLoss`, for a length that is not positive, or a negative factor.
    """

    def __init__(
        self, weight: float | Schedule = 3e-4, num_points: int = 512, *, length: float = 0.02, color: float = 1.0,
        every: int = 4,
    ) -> None:  # fmt: skip
        super().__init__(weight, num_points, every=every)
        check_positive("length", length)
        check_positive("color", color, allow_zero=True)
        self.length = length
        self.color = color

    def _penalty(self, field: DeformedField, points: MotionPoints) -> Tensor:
        """Squared change of opacity and of the three colours, each seen from some direction."""
        numbers = torch.arange(len(points.times), dtype=points.times.dtype, device=points.times.device)
        # Spread evenly over all times, whatever the points' directions are.
        others = (points.times + (math.sqrt(2) - 1) * (numbers + 0.5)) % 1
        views = spread_directions(points.canonical)
        outputs = [field.canonical(points.canonical, views, times) for times in (points.times, others)]
        here, there = (
            torch.cat([-torch.expm1(-self.length * output.density)[:, None], output.rgb], dim=-1) for output in outputs
        )
        changes = (here - there).square()
        return changes[:, 0] + self.color * changes[:, 1:].sum(-1)


def spread_numbers(shape: Sequence[int], most: int, device: torch.device) -> Tensor | slice:
    """At most so many numbers of samples of a layout (N,) or (R, S), evenly spread over it.

    Dense rays have equally many samples: numbers at equal distances might all be of their first ones, near the camera.
    """
    count = math.prod(shape)
    every = max(1, -(-count // most))
    if len(shape) == 1 or every == 1:
        return slice(None, None, every)
    numbers = torch.arange(count // every, device=device)
    return numbers * every + ((numbers.double() * GOLDEN_RATIO) % 1 * every).long()


def saturated(prices: Tensor, saturation: float | None) -> Tensor:
    """Prices p >= 0 that come no higher than s: p / (1 + p / s), of any shape; None leaves them as they are.

    Of squares this is the Geman-McClure penalty, up to a factor: what is far off is let go, not pulled at the hardest.
    """
    return prices if saturation is None else prices / (1 + prices / saturation)


def spread_directions(like: Tensor) -> Tensor:
    """Unit directions (M, 3), one for each row of the input, spread evenly over the sphere (a Fibonacci lattice)."""
    number = torch.arange(len(like), dtype=like.dtype, device=like.device)
    height = 1 - (2 * number + 1) / max(len(like), 1)
    radius = (1 - height.square()).clamp(min=0).sqrt()
    angle = GOLDEN_ANGLE * number
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), height], dim=-1)
