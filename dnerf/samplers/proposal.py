"""Proposal sampling: small density fields say where along a ray something may be, and the field is evaluated there."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from dnerf.core.checks import as_box, check_shape, check_whole, check_within
from dnerf.core.compositing import render_weights
from dnerf.core.geometry import clip_to_box
from dnerf.core.quadrature import interval_depths
from dnerf.core.rays import Rays, Samples
from dnerf.core.schedules import Scheduled
from dnerf.fields.base import RadianceField
from dnerf.samplers.base import Sampler
from dnerf.samplers.inverse_cdf import sample_piecewise_constant
from dnerf.samplers.stratified import random_points


class ProposalSampler(Sampler, Scheduled):
    """Intervals drawn from a small density field's weights, then from another's; the field is evaluated in the last.

    Intervals of each level cover the whole ray. A proposal is evaluated for density alone: `ImportanceSampler` trains
    its coarse network by the image that it shows, here `HistogramLoss` asks that each proposal's weights are upper
    bounds of the field's, `Samples.bounds`. No gradient goes through where samples lie, or from proposals to rays.

    While proposals know little, weights w are annealed to w^a by Schlick's bias, a = 10 p / (1 + 9 p), p the share of
    `anneal_end` that is done.

    Images leave out intervals where the last proposal's bound is at most `min_weight`; their samples are packed.
    Training leaves out none: what a proposal wrongly excludes must be seen to be missed.

    Source: mip-NeRF 360 (arXiv 2111.12077) section 3, annealing from its appendix. Deviations: even in distance, not
    in disparity; a share of samples is even, in place of dilated histograms; images leave out what bounds exclude.

    Args:
        proposals: density fields, coarse to fine, which may depend on time.
        num_proposed: intervals at which each of them is evaluated.
        num_samples: intervals at which the field is evaluated.
        box: (2, 3), outside which nothing is sampled; None for no limit.
        anneal_end: fraction of training, in [0, 1], until which weights are annealed.
        even_share: of the samples of an opaque ray, drawn evenly, in [0, 1): what proposals have lost is found again.
        min_weight: see above, in [0, 1); 0 leaves nothing out.

    Raises:
        ValueError: for numbers out of range, no proposal, or not a number of intervals for each.
    """

    sets_bounds = True

    def __init__(
        self, proposals: Sequence[RadianceField], num_proposed: Sequence[int] = (64, 48), num_samples: int = 32, *,
        box: Sequence[Sequence[float]] | Tensor | None = None, anneal_end: float = 0.1, even_share: float = 0.05,
        min_weight: float = 1e-3,
    ) -> None:  # fmt: skip
        super().__init__()
        if not len(proposals) or len(proposals) != len(num_proposed):
            raise ValueError(
                f"num_proposed must hold a number for each of at least one proposal, got {list(num_proposed)} "
                f"for {len(proposals)}"
            )
        for name, count in (*(("num_proposed", count) for count in num_proposed), ("num_samples", num_samples)):
            check_whole(name, count)
        check_within("anneal_end", anneal_end, "[0, 1]")
        for name, value in (("even_share", even_share), ("min_weight", min_weight)):
            check_within(name, value, "[0, 1)")
        self.proposals = nn.ModuleList(proposals)
        self.num_proposed, self.num_samples = tuple(num_proposed), num_samples
        self.box = None if box is None else nn.Buffer(as_box(box), persistent=False)
        self.anneal_end, self.even_share, self.min_weight = anneal_end, even_share, min_weight
        self.set_progress(0.0)

    def set_progress(self, progress: float) -> None:
        """Trust weights as far as training stands, `progress` in [0, 1]; images trust them in full."""
        share = 1.0 if progress >= self.anneal_end else progress / self.anneal_end
        self.training_power = 10 * share / (1 + 9 * share)

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Samples (R, num_samples), with bounds; in images packed ones, of those that the last bound allows."""
        near, far = rays.near.detach(), torch.maximum(rays.near, rays.far).detach()
        if self.box is not None:
            corners = self.box.to(near.dtype)
            near, far = clip_to_box(rays.origins.detach(), rays.directions.detach(), near, far, corners)
        edges, weights = torch.stack([near, far], dim=-1), torch.ones_like(near)[:, None]
        levels = []
        for proposal, count in zip(self.proposals, self.num_proposed):
            edges = self._drawn(edges, weights, count, generator)
            weights = self._weights(cast(RadianceField, proposal), rays, edges)
            levels.append((edges, weights))
        edges = self._drawn(edges, weights, self.num_samples, generator)
        starts, ends = edges[:, :-1], edges[:, 1:]
        if self.training:
            bounds = tuple(outer_bound(edges, *level) for level in levels)
            return Samples(starts, ends, len(rays), points=random_points(starts, ends, generator), bounds=bounds)
        samples = Samples(starts, ends, len(rays))
        if not self.min_weight:
            return samples
        return samples.packed(~(outer_bound(edges, *levels[-1]) <= self.min_weight))  # NaN stays

    def _drawn(self, edges: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        """Edges (R, count + 1) of intervals of about the same weight each, from the first edge to the last."""
        inner = edges[:, :0]
        if count > 1:
            power = self.training_power if self.training else 1.0
            lengths = edges.diff(dim=-1)
            total = lengths.sum(-1, keepdim=True)
            even = torch.where(total > 0, lengths / torch.where(total > 0, total, 1.0), 1 / lengths.shape[-1])
            evened = weights.detach() ** power + self.even_share / (1 - self.even_share) * even
            inner = sample_piecewise_constant(edges, evened, count - 1, randomized=self.training, generator=generator)
        return torch.cat([edges[:, :1], inner, edges[:, -1:]], dim=-1)

    def _weights(self, proposal: RadianceField, rays: Rays, edges: Tensor) -> Tensor:
        """Weights (R, S) of a proposal, evaluated in the middle of intervals (R, S + 1), with gradients to it."""
        samples = Samples(edges[:, :-1], edges[:, 1:], len(rays))
        positions, _, times = samples.locate(rays)
        density = proposal.density(positions.detach(), times.detach())
        return render_weights(interval_depths(density, samples.lengths), samples)


def outer_bound(edges: Tensor, proposed_edges: Tensor, proposed_weights: Tensor) -> Tensor:
    """The most that a histogram allows in each interval: the sum of the bins that overlap it by more than a point.

    Args:
        edges: (R, S + 1) sorted, of the intervals.
        proposed_edges: (R, P + 1) sorted, of the histogram's bins.
        proposed_weights: (R, P) >= 0, differentiable.

    Returns:
        (R, S).

    Raises:
        ValueError: if shapes do not fit.

    Source: mip-NeRF 360 (arXiv 2111.12077) eq. 12.
    """
    check_shape("proposed_weights", proposed_weights, ("R", "P"))
    num_rays, num_bins = proposed_weights.shape
    check_shape("proposed_edges", proposed_edges, (num_rays, num_bins + 1))
    check_shape("edges", edges, (num_rays, "S"))
    below = nn.functional.pad(proposed_weights.cumsum(-1), (1, 0))
    sorted_edges = proposed_edges.contiguous()
    first = torch.searchsorted(sorted_edges, edges[:, :-1].contiguous(), right=True).sub(1).clamp(0, num_bins)
    last = torch.searchsorted(sorted_edges, edges[:, 1:].contiguous()).clamp(0, num_bins)
    return (below.gather(-1, last) - below.gather(-1, first)).clamp(min=0)
