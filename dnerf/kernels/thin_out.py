"""Which points stand for their neighbours on a line."""

import torch
from torch import Tensor

from dnerf.core.checks import check_positive

from .backend import choose, run_compiled
from .checks import check_shapes

# Least cosine between steps along one line: what rounding leaves of steps of 1e-4 units, one unit from the origin.
STRAIGHT = 1 - 1e-5


@torch.no_grad()
def thin_out(points: Tensor, times: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    """Choose points such that all others lie between two chosen ones, on a line and less than `2 spacing` apart.

    Points in a row are neighbours if they have one time, are at most `spacing` apart and go on in one direction. Of a
    row of neighbours the first one is chosen, the last one, and the first one in each further `spacing` from the first.

    Args:
        points: (N, 3), in any unit.
        times: (N,).
        spacing: in the points' unit, > 0.

    Returns:
        chosen (M,) int64, numbers of points; which (N,) int64 of them each point comes after, or is; and how far (N,)
        it is on the way from there to the next one, in [0, 1]: 0 for those chosen. Not differentiable.

    Raises:
        ValueError: shapes that do not fit, or a spacing that is not positive.
    """
    check_shapes(points=(points, ("N", 3)), times=(times, points.shape[:1]))
    check_positive("spacing", spacing)
    if points.is_cpu and choose(points) == "numba":
        return run_compiled("thin_out", "thin_out", points, times, spacing)
    return thin_out_reference(points, times, spacing)


def thin_out_reference(points: Tensor, times: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    """The definition of `thin_out` in plain torch."""
    count, places = len(points), points.double()
    steps = places.diff(dim=0)
    lengths = steps.norm(dim=-1)
    is_near = (times.diff() == 0) & (lengths <= spacing)
    turns = (steps[1:] * steps[:-1]).sum(-1) < STRAIGHT * lengths[1:] * lengths[:-1]
    follows = is_near.clone()
    follows[1:] &= ~(is_near[:-1] & turns)
    begins, ends = torch.ones_like(times, dtype=torch.bool), torch.ones_like(times, dtype=torch.bool)
    begins[1:], ends[:-1] = ~follows, ~follows
    numbers = torch.arange(count, device=points.device)
    first = torch.where(begins, numbers, 0).cummax(0).values if count else numbers
    part = ((places - places[first]).norm(dim=-1) / spacing).floor()
    is_chosen = begins | ends
    is_chosen[1:] |= part.diff() != 0
    chosen, before = is_chosen.nonzero()[:, 0], is_chosen.cumsum(0) - 1
    start = places[chosen][before]
    way = (places[chosen][(before + 1).clamp(max=len(chosen) - 1)] - start).norm(dim=-1)
    fractions = (places - start).norm(dim=-1) / way.where(way > 0, 1)
    return chosen, before, torch.where(is_chosen, 0, fractions).to(points.dtype)
