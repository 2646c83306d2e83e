"""Hierarchical importance sampling: a coarse pass tells where the fine samples go."""

import torch
from torch import Tensor

from dnerf.core.checks import check_positive
from dnerf.core.compositing import FieldOutput, render_weights
from dnerf.core.quadrature import interval_depths
from dnerf.core.rays import Rays, Samples
from dnerf.fields.base import RadianceField
from dnerf.samplers.base import Sampler
from dnerf.samplers.inverse_cdf import sample_piecewise_constant
from dnerf.samplers.stratified import StratifiedSampler, random_points


class ImportanceSampler(Sampler):
    """Stratified coarse samples, then edges drawn from their weights; intervals between all edges are rendered.

    Source: NeRF (arXiv 2003.08934) section 5.2. With a `proposal` field (the coarse network) the coarse pass
    evaluates it and its output goes with the samples, so that a loss can train it; without, the rendered field itself
    (one shared network), for density alone and without gradient.

    Args:
        num_coarse: stratified samples per ray.
        num_fine: edges drawn per ray; the fine pass has `num_coarse + num_fine` intervals.
        proposal: the coarse network, or None for a shared one.
        box: (2, 3), outside which nothing is sampled; None for no limit.

    Raises:
        ValueError: if a number is not positive.
    """

    def __init__(
        self, num_coarse: int = 64, num_fine: int = 64, proposal: RadianceField | None = None, *,
        box: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        check_positive("num_fine", num_fine)
        self.coarse = StratifiedSampler(num_coarse, box)
        self.num_fine = num_fine
        self.proposal = proposal

    def forward(self, rays: Rays, field: RadianceField, *, generator: torch.Generator | None = None) -> Samples:
        """Dense samples (R, num_coarse + num_fine), with the coarse pass in `proposals` if it has its own network."""
        coarse = self.coarse(rays, field, generator=generator)
        positions, directions, times = coarse.locate(rays)
        proposals: tuple[tuple[Samples, FieldOutput], ...] = ()
        if self.proposal is None:
            with torch.no_grad():
                density = field.density(positions, times)
        else:
            proposals = ((coarse, self.proposal(positions, directions, times)),)
            density = proposals[0][1].density
        edges = torch.cat([coarse.starts, coarse.ends[:, -1:]], dim=-1)
        weights = render_weights(interval_depths(density.detach(), coarse.lengths), coarse)
        drawn = sample_piecewise_constant(edges, weights, self.num_fine, randomized=self.training, generator=generator)
        merged = torch.cat([edges, drawn], dim=-1).sort(dim=-1).values
        starts, ends = merged[:, :-1], merged[:, 1:]
        within = random_points(starts, ends, generator) if self.training else None
        return Samples(starts, ends, len(rays), points=within, proposals=proposals)
