"""How density between a ray's samples is read: constant per interval, linear or parabolic between neighbours.

A rule says two things: the optical depth of each interval, and how far the light of an interval has the colour of its
neighbours' samples rather than its own. Everything else is alpha compositing as always, dense or packed. Neighbours
are the adjacent samples of a ray whose intervals touch; at a gap (space left out as empty) density is held up to the
interval's end.

- "constant": density and colour of the sample hold all over its interval. Midpoint rule, second order.
- "linear": density is linear between samples (PL-NeRF, arXiv 2310.20685, eqs. 5-8), and the optical depth its exact
  integral. Second order as well: on smooth density its optical depth errs twice as much as the midpoint rule's, the
  other way (trapezia against midpoints). It gains where samples do not lie in the middle, as in stratified training.
  Deviation: colour belongs to the nearest sample rather than to the segment between two.
- "parabolic": the parabola through a sample and its neighbours. With h the length of an interval of equal ones, its
  optical depth is h (s_-  + 22 s + s_+) / 24, its colour the mean of the three with weights (s_-, 22 s, s_+), shifted
  towards the eye by the distance between the interval's middle and the centroid of the light absorbed in it. Fourth
  order on smooth density and colour where intervals are thin enough (optical depth below about 1) for a central
  difference, third order beyond. All weights are positive, so that colours stay colours, and where density begins
  nothing is taken from the empty space in front. This rule is this project's.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_shape
from dnerf.core.rays import Samples

RULES = ("constant", "linear", "parabolic")

OPAQUE = 1e30
"""Density, in 1 / world unit, beyond which any more changes nothing; keeps sums of neighbours finite."""

FAINT = 1e-20
"""Density, in 1 / world unit, up to which colours are not shared between neighbours; keeps quotients finite."""

TOUCHING = 1e-3
"""Gap between two intervals, in parts of the shorter one, up to which they count as touching."""


@dataclass(frozen=True)
class Shares:
    """Shares of an interval's light that have the colour of the sample before and after it, laid out like samples."""

    before: Tensor
    after: Tensor


def optical_depths(density: Tensor, samples: Samples, quadrature: str = "constant") -> tuple[Tensor, Shares | None]:
    """Optical depth of every interval, and whose colour its light has.

    Args:
        density: (R, S) or (N,) at the samples, >= 0, in 1 / world unit.
        samples: dense or packed.
        quadrature: one of `RULES`.

    Returns:
        Optical depths laid out like the density, and shares of the neighbours' colours (None: all its own).

    Raises:
        ValueError: for another rule or layout.
    """
    check_choice("quadrature", quadrature, RULES)
    check_shape("density", density, samples.starts.shape)
    if quadrature == "constant":
        return interval_depths(density, samples.lengths), None
    density = density.clamp(max=OPAQUE)
    if quadrature == "linear":
        return _linear(density, samples), None
    return _parabolic(density, samples)


def interval_depths(density: Tensor, lengths: Tensor) -> Tensor:
    """Optical depth of intervals of constant density: their product, 0 for infinite density on no length at all."""
    return density.clamp(max=OPAQUE) * lengths


def spread_weights(weights: Tensor, shares: Shares, samples: Samples) -> Tensor:
    """Weights of the samples' colours from weights of intervals, both (R, S) or (N,); sums along rays are kept."""
    to_before, to_after = weights * shares.before, weights * shares.after
    return weights - to_before - to_after + _after(to_before) + _before(to_after)


def _before(values: Tensor) -> Tensor:
    """Each sample's predecessor along the last axis; zero for the first."""
    return torch.cat([torch.zeros_like(values[..., :1]), values[..., :-1]], dim=-1)


def _after(values: Tensor) -> Tensor:
    return torch.cat([values[..., 1:], torch.zeros_like(values[..., :1])], dim=-1)


def _touches_next(samples: Samples) -> Tensor:
    """Whether an interval is followed by another of its ray without a gap, and by another point; like samples."""
    next_start, shorter = _after(samples.starts), torch.minimum(samples.lengths, _after(samples.lengths))
    joined = (next_start - samples.ends).abs() <= TOUCHING * shorter
    # What has no length, padding above all, is no neighbour.
    touches = joined & (shorter > 0) & (_after(samples.distances) > samples.distances)
    touches[..., -1:] = False
    if samples.ray_indices is not None:
        touches[:-1] &= samples.ray_indices[1:] == samples.ray_indices[:-1]
    return touches


def _linear(density: Tensor, samples: Samples) -> Tensor:
    points, starts, ends = (x.to(density.dtype) for x in (samples.distances, samples.starts, samples.ends))
    touches = _touches_next(samples)
    span = torch.where(touches, _after(points) - points, 1.0)
    share = torch.where(touches, (ends - points) / span, 0.0)
    at_end = density + share * (_after(density) - density)
    at_start = torch.where(_before(touches), _before(at_end), density)
    before, after = points - starts, ends - points
    return 0.5 * (before * at_start + after * at_end) + 0.5 * (before + after) * density


def _parabolic(density: Tensor, samples: Samples) -> tuple[Tensor, Shares]:
    points, lengths = (x.to(density.dtype) for x in (samples.distances, samples.lengths))
    touches = _touches_next(samples)
    touched = _before(touches)
    to_next = torch.where(touches, _after(points) - points, 1.0)
    to_last = torch.where(touched, points - _before(points), 1.0)
    both = touches & touched
    # Second differences on unequal steps; at random points a step may be much shorter than the interval.
    # Quotients of lengths, since the square of one may overflow.
    share = torch.where(both, lengths / (12 * (to_last + to_next)), 0.0)
    shortest = 1e-6 * lengths
    last, following = (share * (lengths / torch.maximum(step, shortest)) for step in (to_last, to_next))
    too_much = (last + following).clamp(min=1.0)
    last, following = last / too_much, following / too_much
    mass_before, mass_after = last * _before(density), following * _after(density)
    mass = (1 - last - following).clamp(min=0) * density + mass_before + mass_after
    depth = mass * lengths
    before, after = _share(mass_before, mass), _share(mass_after, mass)
    # Where density begins, what lies in front has no colour to speak of.
    trusted = _share(torch.minimum(_before(density), 0.25 * density), 0.25 * density)
    shift = torch.where(touched, trusted * _centroid_shift(depth) * lengths, 0.0)
    # From behind to the front as far as there is something behind (a central difference), from the sample beyond.
    moved = torch.minimum(after, shift / (to_last + to_next))
    rest = ((shift - moved * (to_last + to_next)) / to_last).clamp(min=0)
    after = after - moved
    before = torch.minimum(before + moved + rest, 1 - after)
    return depth, Shares(before, after)


def _share(part: Tensor, whole: Tensor) -> Tensor:
    """A part of a whole, in [0, 1]; 0 where there is next to nothing, whose shares no image shows."""
    faint = whole <= FAINT
    return torch.where(faint, 0.0, part / torch.where(faint, 1.0, whole))


def _centroid_shift(depth: Tensor) -> Tensor:
    """How far in front of its middle an interval absorbs light on average, in parts of its length, in [0, 1/2).

    1/2 - 1/x + 1/(e^x - 1) for the optical depth x; by its series where that cancels.
    """
    thin = depth < 0.5
    x = torch.where(thin, depth, 0.0)
    series = x / 12 * (1 - x * x / 60 * (1 - x * x / 42))
    y = torch.where(thin, 1.0, depth)
    return torch.where(thin, series, 0.5 - 1 / y + torch.exp(-y) / -torch.expm1(-y))
