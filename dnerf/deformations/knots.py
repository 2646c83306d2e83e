"""A deformation along rays: evaluated at some places of each, and linear in between."""

import torch
from torch import Tensor

from dnerf.deformations.base import Deformation

STRAIGHT = 1 - 1e-4  # least cosine between steps on one line
PAD_TO = 2048  # knots: matrix libraries compile code for every new number of rows


def between_knots(deformation: Deformation, positions: Tensor, times: Tensor, spacing: float) -> Tensor:
    """Canonical positions of samples along rays, from the displacements at fewer places.

    Neighbours in the list that follow each other along a straight line at one time, no further apart than `spacing`,
    make a run. A run's ends are knots, and the first sample in each `spacing` of it. Only they are evaluated; the
    displacements of what lies between two knots are interpolated, so the error falls with the square of the spacing.
    What is in no run is evaluated as it is.

    Args:
        deformation: world -> canonical. It gets gradients, positions and times get none.
        positions: (N, 3), N >= 1.
        times: (N,).
        spacing: in world units.

    Returns:
        (N, 3).
    """
    with torch.no_grad():
        places, arcs = _knots(positions, times, spacing)
        is_knot = torch.zeros_like(arcs, dtype=torch.bool).index_fill_(0, places, True)
        before = is_knot.cumsum(0) - 1
        after = (before + ~is_knot).clamp_(max=len(places) - 1)
        first, last = (arcs[places[i]] for i in (before, after))
        share = ((arcs - first) / (last - first).clamp_(min=torch.finfo(arcs.dtype).tiny)).to(positions.dtype)
        places = torch.cat([places, places[-1:].expand(-len(places) % PAD_TO)])
        knots, at = positions.index_select(0, places), times.index_select(0, places)
    displacements = deformation(knots, at) - knots
    first, last = (displacements.index_select(0, i) for i in (before, after))
    return positions + torch.lerp(first, last, share[:, None])


def _knots(positions: Tensor, times: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Numbers (K,) of the samples that are knots, and how far each sample (N,) lies along all runs, in float64."""
    steps = positions.diff(dim=0)
    lengths = steps.norm(dim=-1)
    is_far = ~(lengths <= spacing) | (times.diff() != 0)  # NaN is
    cosines = (steps[1:] * steps[:-1]).sum(-1)
    turns = (cosines <= STRAIGHT * lengths[1:] * lengths[:-1]) & (lengths[1:] > 0)
    breaks = is_far.clone()
    breaks[1:] |= turns & ~is_far[:-1]
    begins = torch.nn.functional.pad(breaks, (1, 0), value=True)
    arcs = torch.nn.functional.pad(torch.where(breaks, 0, lengths).cumsum(0, dtype=torch.float64), (1, 0))
    numbers = torch.arange(len(arcs), device=arcs.device)
    along = arcs - arcs[torch.where(begins, numbers, 0).cummax(0).values]
    cells = (along / spacing).floor_()
    is_knot = begins.clone()
    is_knot[1:] |= cells.diff() != 0
    is_knot[:-1] |= breaks
    is_knot[-1] = True
    return is_knot.nonzero()[:, 0], arcs
