"""Which intervals of rays are visible, and the parts into which they are cut."""

from typing import NamedTuple

import torch
from torch import Tensor

from dnerf.core.checks import check_whole
from dnerf.core.rays import parts_of

from .backend import choose, run_compiled
from .checks import check_offsets, check_shapes
from .packed_weights import MOST_DENSITY, packed_weights


class SeenParts(NamedTuple):
    """M intervals, whole ones and parts, of R rays.

    Args:
        starts, ends: (M,) distances along the rays, in order.
        ray_indices: (M,) int64.
        offsets: (R + 1,) int64, where each ray's begin and end.
        whole: (M,) int64, of which given interval each is, or is a part.
        new: (P,) int64, those of them, in order, in whose middle that interval's middle is not.
    """

    starts: Tensor
    ends: Tensor
    ray_indices: Tensor
    offsets: Tensor
    whole: Tensor
    new: Tensor


@torch.no_grad()
def seen_parts(
    starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor, light: Tensor, *, subdivision: int,
    subdivision_weight: float, min_weight: float,
) -> SeenParts:  # fmt: skip
    """Leave out intervals that are not visible, and cut those that are well visible into parts of equal lengths.

    An interval's weight is `packed_weights` of its optical depth times the light that comes to its ray's first one.
    Those up to `min_weight` are left out, those up to `subdivision_weight` stay whole, those above and NaN are cut. Not
    differentiable.

    Args:
        starts, ends: (N,) distances along R rays, ray by ray and in order.
        offsets: (R + 1,) int64, where each ray's intervals begin and end.
        density: (N,), in 1 / unit of the distances, >= 0.
        light: (R,) transmittance before each ray's first interval.
        subdivision: parts of an interval that is cut, >= 1.
        subdivision_weight, min_weight: see above.

    Raises:
        ValueError: shapes that do not fit each other, subdivision below 1, or (by the compiled version) offsets that do
            not run from 0 to N.
    """
    check_whole("subdivision", subdivision)
    check_offsets(offsets)
    check_shapes(starts=(starts, ("N",)), ends=(ends, starts.shape), density=(density, starts.shape))
    check_shapes(light=(light, (len(offsets) - 1,)))
    arguments = (starts, ends, offsets, density, light, subdivision, subdivision_weight, min_weight)
    is_of_one_kind = all(x.dtype == starts.dtype for x in (ends, density, light))
    if is_of_one_kind and choose(starts) == "numba":
        return SeenParts(*run_compiled("seen_parts", "seen_parts", *arguments))
    return seen_parts_reference(*arguments)


def seen_parts_reference(
    starts: Tensor, ends: Tensor, offsets: Tensor, density: Tensor, light: Tensor, subdivision: int,
    subdivision_weight: float, min_weight: float,
) -> SeenParts:  # fmt: skip
    """The definition of `seen_parts` in plain torch."""
    rays = torch.repeat_interleave(offsets.diff())
    weights = packed_weights(density.clamp(max=MOST_DENSITY) * (ends - starts), offsets) * light[rays]
    counts = torch.where(weights <= min_weight, 0, torch.where(weights <= subdivision_weight, 1, subdivision))
    whole, number = parts_of(counts)
    before = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    first, last, parts = starts[whole], ends[whole], counts[whole]
    return SeenParts(  # parts' ends are exact at both ends of the whole
        starts=torch.lerp(first, last, number / parts.to(first.dtype)),
        ends=torch.lerp(first, last, (number + 1) / parts.to(first.dtype)), ray_indices=rays[whole],
        offsets=before[offsets], whole=whole, new=(2 * number + 1 != parts).nonzero()[:, 0],
    )  # fmt: skip
