"""Walking rays front to back in rounds, so that nothing is evaluated behind what is opaque."""

from collections.abc import Callable

import torch
from torch import Tensor

from dnerf.core.compositing import render_weights, sum_along_rays
from dnerf.core.quadrature import interval_depths
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField, density_of_samples

Source = Callable[[Tensor, int, int], tuple[Samples, Tensor]]
Visitor = Callable[[Tensor, Samples, Tensor], Tensor]
Observer = Callable[[Tensor, Tensor, Tensor], None]


@torch.no_grad()
def walk_front_to_back(
    source: Source, rays: Tensor, stop_transmittance: float, visit: Visitor, *, first_round: int = 8,
    most_at_once: int = 1 << 18,
) -> None:  # fmt: skip
    """Visit the samples of rays in rounds: the first few of each, twice as many, and so on, until it is opaque.

    Source: early ray termination (Levoy 1990), here for whole batches of rays at a time.

    Args:
        source: called with the numbers (K,) of rays, how many samples of each have been visited, and a size; returns
            at most so many further samples of each as packed samples of K rays, and which rays (K,) may have more.
        rays: (R,) numbers of the rays that take part.
        stop_transmittance: a ray whose transmittance has fallen to this takes no further part.
        visit: called with the numbers (K,) of the rays that take part, their samples, and their transmittance (K,)
            before them; returns the share (K,) of light that passes them.
        first_round: samples per ray in the first round.
        most_at_once: samples of all rays in a round (one of each ray at least); bounds the memory.
    """
    taken, size = 0, first_round
    before: Tensor | None = None
    while len(rays):
        size = max(1, min(size, most_at_once // len(rays)))
        part, has_more = source(rays, taken, size)
        before = part.starts.new_ones(len(rays)) if before is None else before
        after = before * visit(rays, part, before)
        taken, size = taken + size, 2 * size
        goes_on = (after > stop_transmittance) & has_more
        rays, before = rays[goes_on], after[goes_on]


class PackedRounds:
    """Packed samples as the source of `walk_front_to_back`, in rounds padded to a multiple of so many."""

    def __init__(self, samples: Samples, pad_to: int = 1) -> None:
        self.samples, self.pad_to = samples, pad_to
        self.counts = samples.offsets.diff()
        self.rays = self.counts.nonzero()[:, 0]  # (K,) numbers of those that have samples
        self.chosen = torch.empty(0, dtype=torch.int64)  # (n,) numbers of the latest round's samples, for visitors

    def __call__(self, rays: Tensor, taken: int, size: int) -> tuple[Samples, Tensor]:
        """The samples of some rays from number `taken` on."""
        samples, counts = self.samples, self.counts[rays]
        offsets = torch.nn.functional.pad((counts - taken).clamp(0, size).cumsum(0), (1, 0))
        total = int(offsets[-1])
        local = torch.repeat_interleave(offsets.diff(), output_size=total)
        shift = (samples.offsets[rays] + taken - offsets[:-1]).index_select(0, local)
        self.chosen = torch.arange(total, device=local.device) + shift
        part = Samples(
            samples.starts.index_select(0, self.chosen), samples.ends.index_select(0, self.chosen), len(rays),
            ray_indices=local, points=None if samples.points is None else samples.points.index_select(0, self.chosen),
            ray_offsets=offsets,
        )  # fmt: skip
        return part.padded(self.pad_to), counts > taken + size


@torch.no_grad()
def visible_weights(
    samples: Samples, rays: Rays, field: RadianceField, min_weight: float, *, first_round: int = 8,
    most_at_once: int = 1 << 18, pad_to: int = 1, observe: Observer | None = None,
) -> Tensor:  # fmt: skip
    """Evaluate the field's density front to back for the samples' weights in the image.

    An image of the samples above `min_weight` alone differs from that of all by at most `min_weight` for each sample
    in front and `min_weight` for all behind. As a filter before the pass with gradients it is nerfacc's (arXiv
    2305.04966).

    Args:
        samples: N packed samples of the rays.
        rays: R rays.
        field: whose density decides.
        min_weight: least weight that counts, in (0, 1); a ray whose transmittance has fallen to this is at its end.
        first_round: samples per ray in the first round, see `walk_front_to_back`.
        most_at_once: samples of all rays in a round, likewise; if there are no more, all may be one.
        pad_to: the field is evaluated at a multiple of so many points.
        observe: told positions (n, 3), times (n,) and density (n,) of every round.

    Returns:
        (N,), zero behind the end of a ray.
    """
    found = torch.zeros_like(samples.starts)
    rounds = PackedRounds(samples, pad_to)

    def visit(ray_numbers: Tensor, part: Samples, transmittance: Tensor) -> Tensor:
        density, positions, times = density_of_samples(field, part, rays[ray_numbers])
        if observe is not None:
            observe(positions, times, density)
        optical_depth = interval_depths(density, part.lengths)
        weights = render_weights(optical_depth, part) * part.per_sample(transmittance)
        found[rounds.chosen] = weights[: len(rounds.chosen)]
        return torch.exp(-sum_along_rays(optical_depth, part))

    is_few = samples.starts.numel() <= most_at_once
    walk_front_to_back(
        rounds, rounds.rays, min_weight, visit,
        first_round=first_round, most_at_once=first_round * len(rays) if is_few else most_at_once,
    )  # fmt: skip
    return found


@torch.no_grad()
def by_chance(chances: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Take samples (N,) with such chances in [0, 1]; of neighbours as many as their chances add up to: systematic
    sampling (Kitagawa, JCGS 1996)."""
    unit = torch.rand((), generator=generator, dtype=torch.float64, device=chances.device)
    sums = torch.nn.functional.pad((chances.cumsum(0, dtype=torch.float64) + unit).floor(), (1, 0))
    return sums.diff() > 0
