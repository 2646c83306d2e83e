"""Packed samples in a fixed number of places, whatever their number is: what CUDA graphs need.

Nothing here waits for a device: how many samples there are is known on the device only.
"""

from typing import NamedTuple

import torch
from torch import Tensor


class Fit(NamedTuple):
    """Which sample each of S places shows."""

    source: Tensor  # (S,) int64 number of the sample; any valid one for an empty place
    part: Tensor  # (S,) int64, which of the sample's parts, from 0
    is_filled: Tensor  # (S,) bool
    rays: Tensor  # (S,) int64, sorted, the ray of each place
    offsets: Tensor  # (R + 1,) int64; ray r owns places `offsets[r] : offsets[r + 1]`, the filled ones first
    wanted: Tensor  # () int64, places that all rays would have filled


def spread(wanted: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Deal out places to rays in their order: all that one wants or, from the first that does not fit on, none.

    What is left goes to all rays evenly, as empty places: a loop over a ray's samples stays short.

    Args:
        wanted: (R,) int64 places that each ray wants, R > 0.
        size: S, number of places.

    Returns:
        (R,) int64 places that each ray fills, and (R + 1,) int64 offsets of its filled and empty ones, from 0 to S.
    """
    ends = wanted.cumsum(0)
    filled = torch.where(ends <= size, wanted, 0)
    before = torch.nn.functional.pad(filled.cumsum(0), (1, 0))
    left = size - before[-1]
    number = torch.arange(len(before), device=wanted.device)
    return filled, before + number * left // len(wanted)


def placed(rays: Tensor, is_filled: Tensor, num_rays: int, wanted: Tensor) -> Tensor:
    """Which rays (R,) got what they wanted of S places: if that was too much, those up to the last that got any.

    Rays, (S,) int64, and `is_filled`, (S,) bool, are those of the places, `wanted` () how many all would have filled.
    """
    last = torch.where(is_filled, rays, -1).amax()
    return (wanted <= len(rays)) | (torch.arange(num_rays, device=rays.device) <= last)


def fit(offsets: Tensor, counts: Tensor, size: int) -> Fit:
    """Put packed samples, each any number of times, into a fixed number of places.

    Args:
        offsets: (R + 1,) int64 from 0 to N; ray r owns samples `offsets[r] : offsets[r + 1]`; R > 0.
        counts: (N,) int64 places that each sample wants, >= 0; N > 0.
        size: S, number of places; see `spread` for what does not fit.
    """
    before = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    firsts = before[offsets]
    filled, places = spread(firsts.diff(), size)
    rays = torch.repeat_interleave(places.diff(), output_size=size)
    slots = torch.arange(size, device=counts.device)
    within = slots - places[rays]
    number = firsts[rays] + within
    source = torch.searchsorted(before[1:], number, right=True).clamp(max=len(counts) - 1)
    return Fit(source, number - before[source], within < filled[rays], rays, places, before[-1])
