"""A deformation along rays: evaluated at some places of each, and linear in between."""

import torch
from torch import Tensor

from dnerf.deformations.base import Deformation

STRAIGHT = 1 - 1e-4  # least cosine between steps on one line
PAD_TO = 2048  # knots: matrix libraries compile code for every new number of rows


def between_knots(deformation: Deformation, positions: Tensor, times: Tensor, spacing: float) -> Tensor:
    """Canonical positions (N, 3) of samples along rays, from displacements at fewer places.

    Neighbours in the list that follow each other along a straight line at one time, no further apart than `spacing` (in
    world units), make a run. Its ends are knots, and the first sample in each `spacing` of it. The deformation is
    evaluated there; what lies between two knots gets displacements that err by the square of the spacing. What is in no
    run is evaluated as it is. Positions (N, 3), N >= 1, and times (N,) get no gradients.
    """
    with torch.no_grad():
        is_knot, arcs = _knots(positions, times, spacing)
        places = is_knot.nonzero()[:, 0]
        before = is_knot.cumsum(0) - 1
        after = (before + ~is_knot).clamp_(max=len(places) - 1)
        first, last = (arcs[places[i]] for i in (before, after))
        share = ((arcs - first) / (last - first).clamp_(min=torch.finfo(arcs.dtype).tiny)).to(positions.dtype)
        places = torch.cat([places, places[-1:].expand(-len(places) % PAD_TO)])
        knots, at = positions.index_select(0, places), times.index_select(0, places)
    moved = deformation(knots, at) - knots
    first, last = (moved.index_select(0, i) for i in (before, after))
    return positions + torch.lerp(first, last, share[:, None])


def _knots(positions: Tensor, times: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Which samples (N,) are knots, and how far each (N,) lies along all runs, in float64."""
    steps = positions.diff(dim=0)
    lengths = steps.norm(dim=-1)
    is_far = ~(lengths <= spacing) | (times.diff() != 0)  # NaN is
    turns = ((steps[1:] * steps[:-1]).sum(-1) <= STRAIGHT * lengths[1:] * lengths[:-1]) & (lengths[1:] > 0)
    breaks = is_far.clone()
    breaks[1:] |= turns & ~is_far[:-1]
    is_knot = torch.nn.functional.pad(breaks, (1, 0), value=True)
    arcs = torch.nn.functional.pad(torch.where(breaks, 0, lengths).cumsum(0, dtype=torch.float64), (1, 0))
    begins = torch.where(is_knot, torch.arange(len(arcs), device=arcs.device), 0).cummax(0).values
    is_knot[1:] |= ((arcs - arcs[begins]) / spacing).floor_().diff() != 0
    is_knot[:-1] |= breaks
    is_knot[-1] = True
    return is_knot, arcs
