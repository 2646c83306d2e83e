"""Inverse-CDF sampling against a loop, and against its histogram by counting."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference import invert_histogram

from dnerf.samplers import sample_piecewise_constant


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


histograms = st.lists(
    st.tuples(st.one_of(st.just(0.0), st.floats(1e-3, 2)), st.one_of(st.just(0.0), st.floats(1e-3, 1e3))),
    min_size=1,
    max_size=8,
).filter(lambda bins: sum(weight for _, weight in bins) > 1e-3)


@given(bins=histograms, num_samples=st.integers(1, 9))
def test_draws_agree_with_a_loop(bins: list[tuple[float, float]], num_samples: int) -> None:
    edges = [2.0]
    for width, _ in bins:
        edges.append(edges[-1] + width)
    weights = [weight for _, weight in bins]
    drawn = sample_piecewise_constant(
        torch.tensor([edges], dtype=torch.float64), torch.tensor([weights], dtype=torch.float64), num_samples
    )[0]
    expected = [invert_histogram(edges, weights, (k + 0.5) / num_samples) for k in range(num_samples)]
    for got, want in zip(drawn.tolist(), expected, strict=True):
        # Where a gap without weight is crossed, rounding may pick either of its ends.
        same = abs(got - want) < 1e-9
        assert same or gap_between(edges, weights, *sorted((got, want)))


def gap_between(edges: list[float], weights: list[float], low: float, high: float) -> bool:
    """Whether hardly any weight lies between two positions."""
    between = 0.0
    for a, b, weight in zip(edges[:-1], edges[1:], weights, strict=True):
        if b > a:
            between += weight * max(0.0, min(b, high) - max(a, low)) / (b - a)
    return between <= 1e-9 * sum(weights)


@pytest.mark.parametrize("scale", [0.0, 1e-38, 1e-45])
def test_a_histogram_without_weight_is_sampled_uniformly(scale: float) -> None:
    edges = torch.linspace(2, 6, 9).expand(3, 9)
    weights = scale * torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0]).expand(3, 8)
    drawn = sample_piecewise_constant(edges, weights, 16)
    expected = 2 + 4 * (torch.arange(16) + 0.5) / 16
    torch.testing.assert_close(drawn, expected.expand(3, 16), rtol=1e-6, atol=0)


def test_a_histogram_that_is_nearly_empty_is_partly_filled() -> None:
    """Half the guard's total 1e-5 in the first of two bins: it keeps its half and gets a quarter."""
    drawn = sample_piecewise_constant(torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[5e-6, 0.0]]), 400)
    assert (drawn < 1).float().mean().item() == pytest.approx(0.75, abs=1 / 400)


@pytest.mark.parametrize("bin_index", [0, 3, 15])
@pytest.mark.parametrize("weight", [1e-4, 1.0, 1e30])
@pytest.mark.parametrize("randomized", [False, True])
def test_one_spike_gets_every_sample(bin_index: int, weight: float, randomized: bool) -> None:
    edges = torch.linspace(2, 6, 17).expand(500, 17)
    weights = torch.zeros(500, 16)
    weights[:, bin_index] = weight
    drawn = sample_piecewise_constant(edges, weights, 64, randomized=randomized, generator=seeded())
    assert (drawn >= edges[0, bin_index]).all()
    assert (drawn <= edges[0, bin_index + 1]).all()
    assert (drawn.max() - drawn.min()).item() > 0.9 * 0.25


@pytest.mark.parametrize("extreme", [0.0, 1 - 2**-24])
def test_extreme_random_numbers_stay_out_of_empty_bins(monkeypatch: pytest.MonkeyPatch, extreme: float) -> None:
    """0 lies before the empty bins at the start; the largest float32 below 1 rounds the last stratum to u = 1."""
    monkeypatch.setattr(torch, "rand", lambda size, **options: torch.full(size, extreme, dtype=options["dtype"]))
    edges, weights = torch.linspace(0, 6, 7)[None], torch.tensor([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]])
    drawn = sample_piecewise_constant(edges, weights, 64, randomized=True)
    assert (drawn >= 2).all()
    assert (drawn <= 4).all()


def test_random_draws_follow_the_histogram() -> None:
    """One draw for each of many rays is an independent sample; counts in half bins also show that bins are uniform."""
    count = 40000
    weights = torch.tensor([0.1, 0.0, 2.0, 0.5, 1.4], dtype=torch.float64)
    edges = torch.tensor([0.0, 1.0, 1.5, 2.0, 4.0, 4.5], dtype=torch.float64)
    drawn = sample_piecewise_constant(
        edges.expand(count, 6), weights.expand(count, 5), 1, randomized=True, generator=seeded()
    )[:, 0]
    halves = torch.stack([edges[:-1], 0.5 * (edges[:-1] + edges[1:])], -1).flatten()
    observed = torch.bincount(torch.searchsorted(halves, drawn, right=True) - 1, minlength=10).double()
    expected = count * (weights / weights.sum() / 2).repeat_interleave(2)
    assert observed[expected == 0].sum() == 0
    filled = expected > 0
    statistic = ((observed - expected)[filled] ** 2 / expected[filled]).sum().item()
    # Chi-square with 7 degrees of freedom exceeds 24.3 once in a thousand; the seed is fixed.
    assert statistic < 24.3


def test_strata_spread_draws_better_than_chance() -> None:
    """Each of n strata of the CDF holds exactly one draw."""
    drawn = sample_piecewise_constant(
        torch.tensor([[0.0, 1.0]]).expand(100, 2), torch.ones(100, 1), 8, randomized=True, generator=seeded()
    )
    assert torch.equal((8 * drawn).floor(), torch.arange(8.0).expand(100, 8))


def test_no_gradient_flows() -> None:
    weights = torch.rand(2, 4, requires_grad=True)
    edges = torch.linspace(0, 1, 5).expand(2, 5).clone().requires_grad_()
    assert not sample_piecewise_constant(edges, weights, 3).requires_grad


@pytest.mark.parametrize(("call", "message"), [
    (lambda: sample_piecewise_constant(torch.zeros(2, 4), torch.zeros(2, 4), 3), r"edges must have shape \(2, 5\)"),
    (lambda: sample_piecewise_constant(torch.zeros(5), torch.zeros(4), 3), r"weights must have shape \(R, S\)"),
    (lambda: sample_piecewise_constant(torch.zeros(2, 5), torch.zeros(2, 4), 0), "num_samples must be > 0"),
])  # fmt: skip
def test_arguments_that_do_not_fit_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
