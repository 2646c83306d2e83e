"""Stratified sampling: equal intervals, points uniform within them."""

import math

import pytest
import torch
from reference import fog, rays_towards_origin

from dnerf.core.rays import Rays
from dnerf.samplers import StratifiedSampler


def test_intervals_are_equal_and_cover_the_ray() -> None:
    rays = rays_towards_origin(5, torch.float64)
    samples = StratifiedSampler(10).eval()(rays, fog())
    expected = 1 + 4 * torch.arange(11, dtype=torch.float64) / 10
    torch.testing.assert_close(samples.starts, expected[:-1].expand(5, 10), rtol=1e-15, atol=0)
    torch.testing.assert_close(samples.ends, expected[1:].expand(5, 10), rtol=1e-15, atol=0)
    torch.testing.assert_close(samples.distances, (expected[1:] - 0.2).expand(5, 10), rtol=1e-14, atol=0)


def test_training_points_are_uniform_within_their_intervals() -> None:
    count, bins = 4000, 20
    rays = rays_towards_origin(count, torch.float64)
    samples = StratifiedSampler(4).train()(rays, fog(), generator=torch.Generator().manual_seed(0))
    u = (samples.distances - samples.starts) / samples.lengths
    for column in range(4):
        observed = torch.histc(u[:, column], bins, 0, 1)
        statistic = ((observed - count / bins) ** 2 / (count / bins)).sum().item()
        # Chi-square with 19 degrees of freedom exceeds 43.8 once in a thousand; the seed is fixed.
        assert statistic < 43.8
    correlation = torch.corrcoef(u.T) - torch.eye(4, dtype=torch.float64)
    assert correlation.abs().max() < 4 / math.sqrt(count)


def test_random_points_make_the_optical_depth_unbiased() -> None:
    """The mean over many draws of one sample's density times its interval is the integral; the middle's is not."""
    count = 20000
    rays = rays_towards_origin(1, torch.float64)[torch.zeros(count, dtype=torch.int64)]
    rays = Rays(rays.origins, rays.directions, rays.times, 0 * rays.near, 0 * rays.near + 1)
    samples = StratifiedSampler(2).train()(rays, fog(), generator=torch.Generator().manual_seed(0))
    estimates = (samples.distances**4 * samples.lengths).sum(-1)
    deviation = estimates.std().item() / math.sqrt(count)
    assert estimates.mean().item() == pytest.approx(0.2, abs=4 * deviation)
    middle = StratifiedSampler(2).eval()(rays[:1], fog())
    assert (middle.distances**4 * middle.lengths).sum().item() < 0.2 - 10 * deviation


@pytest.mark.parametrize("num_samples", [0, -1])
def test_number_of_samples_must_be_positive(num_samples: int) -> None:
    with pytest.raises(ValueError, match=f"num_samples must be > 0 and finite, got {num_samples}"):
        StratifiedSampler(num_samples)


def test_box_may_be_nested_lists_and_must_not_be_empty() -> None:
    sampler = StratifiedSampler(4, [[-1, -1, -1], [1, 1, 1]])
    assert sampler.state_dict() == {}
    with pytest.raises(ValueError, match="box must have finite corners"):
        StratifiedSampler(4, [[1, -1, -1], [1, 1, 1]])
