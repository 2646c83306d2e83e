"""Proposals bound the field's weights, learn from nothing else, and put samples where they allow some."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import fog, ray_weights, rays_towards_origin, soft_ball
from torch import Tensor

from dnerf.core.compositing import Rendering
from dnerf.core.rays import Rays, Samples
from dnerf.fields import GridField
from dnerf.losses import Batch, HistogramLoss, PhotometricLoss
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import ProposalSampler, StratifiedSampler, outer_bound

BOX = [[-1.5] * 3, [1.5] * 3]
LOSS = HistogramLoss()
BATCH = Batch(torch.rand(8, 4), torch.rand(8, 3))


def small(density_shift: float = -1.0) -> GridField:
    torch.manual_seed(0)
    return GridField(BOX, (8, 16), 2, hidden_features=16, num_layers=1, density_shift=density_shift)


def placed(weights: Tensor, *bounds: Tensor) -> Rendering:
    """Rays of unit intervals with such weights (R, S) and bounds."""
    starts = torch.arange(weights.shape[1], dtype=weights.dtype).expand_as(weights)
    samples = Samples(starts, starts + 1, len(weights), bounds=bounds)
    nothing = torch.zeros(len(weights))
    return Rendering(nothing[:, None].expand(-1, 3), nothing, nothing, weights=weights, samples=samples)


# Few values: edges that coincide, bins and intervals of length zero.
edges_of = st.lists(st.integers(0, 6).map(float), min_size=2, max_size=9).map(sorted)


@given(edges_of, edges_of, st.lists(st.floats(0, 1), min_size=8, max_size=8))
@settings(deadline=None)
def test_the_bound_is_the_sum_of_the_bins_that_overlap(own: list[float], proposed: list[float], raw: list[float]):
    lengths = [high - low for low, high in pairwise(proposed)]
    weights = [w * (length > 0) for w, length in zip(raw, lengths)]  # as of `render_weights`
    rows = [torch.tensor([row], dtype=torch.float64) for row in (own, proposed, weights)]
    expected = [
        sum(w for (low, high), w in zip(pairwise(proposed), weights) if low < end and high > start)
        for start, end in pairwise(own)
    ]
    assert outer_bound(*rows)[0].tolist() == pytest.approx(expected, abs=1e-14)


def test_the_loss_is_that_of_a_loop_over_rays_intervals_and_proposals() -> None:
    weights, first, second = torch.rand(3, 5, 7, dtype=torch.float64)
    weights[0, 2] = first[1, 3] = second[2] = 0
    pairs = [(w, b) for bound in (first, second) for w, b in zip(weights.flatten().tolist(), bound.flatten().tolist())]
    expected = sum(max(0.0, w - b) ** 2 / w for w, b in pairs if w > 0) / len(weights)
    dense = placed(weights, first, second)
    packed = replace(dense, samples=dense.samples.packed(), weights=weights.flatten())
    for rendering in (dense, packed):
        assert LOSS(rendering, BATCH, None).item() == pytest.approx(expected, rel=1e-12)


def test_the_loss_is_zero_where_proposals_bound_the_weights_and_only_there() -> None:
    depths = torch.rand(6, 12, dtype=torch.float64)
    weights = torch.tensor([ray_weights(row) for row in depths.tolist()], dtype=torch.float64)
    edges = torch.arange(13, dtype=torch.float64).expand(6, -1)
    coarse, whole = edges[:, ::3], weights.unflatten(1, (4, 3)).sum(-1)  # the same light in wider bins
    for share, is_zero in ((1.0, True), (1.5, True), (0.3, False)):
        loss = LOSS(placed(weights, outer_bound(edges, coarse, share * whole)), BATCH, None).item()
        assert (loss < 1e-20) == is_zero  # running sums round


def test_gradcheck_of_the_bound_and_the_loss() -> None:
    generator = torch.Generator().manual_seed(0)
    own, proposed = (torch.rand(4, n, generator=generator, dtype=torch.float64).sort(-1).values for n in (7, 5))
    weights, values = (torch.rand(4, n, generator=generator, dtype=torch.float64) for n in (6, 4))
    weights[0, 0] = 0

    def loss(values: Tensor) -> Tensor:
        return LOSS(placed(weights, outer_bound(own, proposed, values)), BATCH, None)

    assert torch.autograd.gradcheck(loss, (values.requires_grad_(),))


def test_faint_weights_have_finite_gradients() -> None:
    bound = torch.zeros(1, 3, requires_grad=True)
    loss = LOSS(placed(torch.tensor([[0.0, 1e-38, 1e-20]]), bound), BATCH, None)
    loss.backward()
    assert [loss.item(), *bound.grad[0].tolist()] == pytest.approx([0, 0, -2, -2])


def test_proposals_learn_from_the_histograms_alone_and_the_field_from_the_image_alone() -> None:
    model, rays = Renderer(small(1.0), ProposalSampler([small(-3.0), small(-3.0)], (16, 16), 8)), rays_towards_origin(8)
    rays.origins.requires_grad_()
    rendering = model(rays)
    assert rendering.proposals == ()
    LOSS(rendering, BATCH, model).backward(retain_graph=True)
    assert rays.origins.grad is None
    assert all(p.grad is None for p in model.field.parameters())
    tables = [proposal.table for proposal in model.sampler.proposals]
    assert all(torch.count_nonzero(table.grad) for table in tables)
    before = [table.grad.clone() for table in tables]
    PhotometricLoss()(rendering, BATCH, model).backward()
    assert all(torch.count_nonzero(p.grad) for p in model.field.parameters())
    assert all(torch.equal(table.grad, gradient) for table, gradient in zip(tables, before))


def test_proposals_find_a_ball_by_the_loss() -> None:
    ball, rays = soft_ball(width=0.15, peak=40.0), rays_towards_origin(256)
    sampler = ProposalSampler([small(-3.0)], (32,), 16, even_share=0.2)
    model, optimizer, losses = Renderer(ball, sampler), torch.optim.Adam(sampler.parameters(), lr=1e-2), []
    for step in range(100):
        model.set_progress(step / 100)
        loss = LOSS(model(rays, generator=torch.Generator().manual_seed(step)), BATCH, model)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    inside = [
        (each.eval()(rays, ball).locate(rays)[0].norm(dim=-1) < 0.4).float().mean().item()
        for each in (StratifiedSampler(16), sampler)
    ]
    assert inside[1] > 3 * inside[0]


def test_samples_are_even_before_training_and_follow_the_bias_then() -> None:
    sampler = ProposalSampler([soft_ball(peak=1e3)], (64,), 16, anneal_end=0.2)
    rays = rays_towards_origin(4, torch.float64)
    lengths = sampler(rays, fog()).lengths
    assert lengths.max() < 3 * 4 / 16  # edges fall anywhere in their strata
    for progress, power in ((0.0, 0.0), (0.02, 1 / 1.9), (0.1, 5 / 5.5), (0.2, 1.0), (0.9, 1.0)):
        sampler.set_progress(progress)
        assert sampler.training_power == pytest.approx(power)
    short = [(each < 0.06).double().mean().item() for each in (lengths, sampler(rays, fog()).lengths)]
    assert short[0] < 0.1
    assert short[1] > 0.5
    assert ProposalSampler([fog()], (4,), anneal_end=0.0).training_power == 1


def test_rays_of_zero_weight_are_sampled_evenly() -> None:
    sampler = ProposalSampler([fog(0.0)] * 2, (8, 8), 4, min_weight=0.0).eval()
    lengths = sampler(rays_towards_origin(3, torch.float64), fog()).lengths
    # Middles of three strata of [1, 5], between the ends.
    torch.testing.assert_close(lengths[0], torch.tensor([2, 4, 4, 2], dtype=torch.float64) / 3)


@pytest.mark.parametrize("counts", [(1, 1), (8, 4)])
@pytest.mark.parametrize("length", [0.0, -1.0, 1e-6])
def test_empty_and_short_rays_have_finite_losses_and_gradients(counts: tuple[int, int], length: float) -> None:
    model = Renderer(small(1.0), ProposalSampler([small()], counts[:1], counts[1]))
    rays = rays_towards_origin(8)
    rendering = model(Rays(rays.origins, rays.directions, rays.times, rays.near, rays.near + length))
    (LOSS(rendering, BATCH, model) + rendering.rgb.sum()).backward()
    assert rendering.weights.shape == (8, counts[1])
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


def test_images_leave_out_what_no_proposal_allows() -> None:
    """By at most `min_weight` for each interval, where bounds hold as here."""
    ball, rays = soft_ball(width=0.2), rays_towards_origin(50, torch.float64)
    sampler = ProposalSampler([soft_ball(width=0.3)], (64,), 32, min_weight=1e-3)
    model = Renderer(ball, sampler).eval()
    kept = model(rays)
    sampler.min_weight = 0.0
    everything = model(rays)
    assert kept.samples.is_packed
    assert len(kept.weights) < 0.8 * everything.weights.numel()
    assert 0 < (kept.opacity - everything.opacity).abs().max() < 32e-3
    assert not model.train()(rays).samples.is_packed


def test_the_loss_asks_for_a_sampler_with_bounds() -> None:
    LOSS.check(Renderer(fog(), ProposalSampler([fog()], (4,))))
    with pytest.raises(ValueError, match="needs a sampler with proposals that set bounds, got StratifiedSampler"):
        LOSS.check(Renderer(fog(), StratifiedSampler(4)))


@pytest.mark.parametrize(("settings", "message"), [
    ({"proposals": []}, "num_proposed must hold a number for each of at least one proposal, got .* for 0"),
    ({"num_proposed": (8, 8)}, "num_proposed must hold"), ({"num_proposed": (0,)}, "num_proposed must be > 0"),
    ({"num_samples": 1.5}, "num_samples must be a whole"), ({"anneal_end": 1.5}, r"anneal_end must be in \[0, 1\]"),
    ({"even_share": 1.0}, r"even_share must be in \[0, 1\)"), ({"min_weight": -0.1}, "min_weight must be in"),
])  # fmt: skip
def test_settings_out_of_range_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ProposalSampler(**{"proposals": [fog()], "num_proposed": (8,), **settings})
