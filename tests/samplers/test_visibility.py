"""Only what can be seen is kept: nothing empty, nothing behind a surface, and the image stays."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import FormulaField, fog, occupancy_sampler, ray_weights, rays_towards_origin
from torch import Tensor

from dnerf.core.compositing import FieldOutput, composite, render_weights, sum_along_rays
from dnerf.core.rays import Rays, Samples
from dnerf.fields import RadianceField
from dnerf.fields.base import IntervalAware
from dnerf.samplers.base import Capacity
from dnerf.samplers.visibility import by_chance, visible_weights


class CountingField(FormulaField):
    """A field that remembers at how many points it was evaluated."""

    num_points = 0

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        self.num_points += len(times)
        return super().density(positions, times)


def ball(density: float = 200.0) -> CountingField:
    return CountingField(lambda x: density * (x.norm(dim=-1) < 0.9), lambda x, d, t: torch.sigmoid(3 * x))


def packed(counts: list[int], length: float = 0.1) -> tuple[Rays, Samples]:
    """Rays with so many intervals each, beginning at distance 0."""
    num_rays = len(counts)
    rays = Rays(
        torch.zeros(num_rays, 3, dtype=torch.float64),
        torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(num_rays, 3),
        torch.linspace(0, 1, num_rays, dtype=torch.float64),
        torch.zeros(num_rays, dtype=torch.float64),
        torch.full((num_rays,), 100.0, dtype=torch.float64),
    )
    indices = torch.repeat_interleave(torch.tensor(counts))
    ranks = torch.cat([torch.arange(c) for c in counts])
    starts = ranks.double() * length
    return rays, Samples(starts, starts + length, num_rays, ray_indices=indices)


def table_field(samples: Samples, values: Tensor) -> RadianceField:
    """A field on the x axis whose density at each sample's point and ray (by its time) is a given number."""
    steps = max(samples.num_rays - 1, 1)
    lookup = {
        (int(ray), round(float(distance), 6)): float(value)
        for ray, distance, value in zip(samples.ray_indices, samples.distances, values)
    }

    class Table(FormulaField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            keys = [(round(t * steps), round(x, 6)) for x, t in zip(positions[:, 0].tolist(), times.tolist())]
            # Padding asks elsewhere, and must add nothing whatever is there.
            return positions.new_tensor([lookup.get(key, 1e3) for key in keys])

    return Table(lambda x: x[..., 0], lambda x, d, t: x)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=6).filter(any), st.integers(0, 2**31),
    st.sampled_from([1e-6, 1e-4, 1e-2]), st.integers(1, 9), st.sampled_from([1, 16]), st.sampled_from([1, 7, 1 << 20]),
)  # fmt: skip
def test_weights_are_those_of_a_loop(
    counts: list[int], seed: int, min_weight: float, first_round: int, pad_to: int, most_at_once: int
) -> None:
    """Whatever the rounds, up to where so little light arrives that nothing can weigh more than `min_weight`."""
    rays, samples = packed(counts)
    draw = torch.Generator().manual_seed(seed)
    densities = 10 ** (torch.rand(sum(counts), generator=draw, dtype=torch.float64) * 8 - 5)
    weights = visible_weights(
        samples, rays, table_field(samples, densities), min_weight,
        first_round=first_round, pad_to=pad_to, most_at_once=most_at_once,
    )  # fmt: skip
    expected = []
    for values in densities.split(counts):
        expected += ray_weights([0.1 * v for v in values.tolist()])
    wanted = torch.tensor(expected, dtype=torch.float64)
    assert torch.equal(weights > min_weight, wanted > min_weight)
    torch.testing.assert_close(torch.where(weights > 0, weights, wanted), wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("min_weight", [1e-2, 1e-3, 1e-4])
def test_image_changes_by_no_more_than_the_stated_bound(min_weight: float) -> None:
    rays = rays_towards_origin(200)
    field = FormulaField(lambda x: torch.exp(-20 * x.square().sum(-1)) * 60, lambda x, d, t: torch.sigmoid(3 * x))
    box = [[-1.0] * 3, [1.0] * 3]
    whole, culled = occupancy_sampler(box, 0.02).train(), occupancy_sampler(box, 0.02, min_weight=min_weight).train()
    images, numbers = [], []
    for sampler in (whole, culled):
        samples = sampler(rays, field, generator=torch.Generator().manual_seed(0))
        images.append(composite(samples, field(*samples.locate(rays)), torch.ones(3)).rgb)
        numbers.append(int((samples.lengths > 0).sum()))
    most_samples = math.ceil(2 * math.sqrt(3) / 0.02) + 1
    assert (images[0] - images[1]).abs().max() <= min_weight * (most_samples + 1)
    assert numbers[1] < 0.6 * numbers[0]


def test_what_lies_behind_a_surface_is_not_even_evaluated() -> None:
    rays = rays_towards_origin(64)
    field = ball()
    samples = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, pad_to=1).eval()(rays, field)
    is_seen = visible_weights(samples, rays, field, 1e-4) > 1e-4
    assert field.num_points < 0.5 * len(samples.starts)
    # Density 200 over steps of 0.02: three intervals leave exp(-12) of the light.
    inside = samples.locate(rays)[0].norm(dim=-1) < 0.9
    assert not (is_seen & ~inside).any()
    assert is_seen.any()
    assert torch.bincount(samples.ray_indices[is_seen], minlength=64).max() <= 3


def test_a_thin_start_keeps_every_sample() -> None:
    """Before training every sample has weight, and each must get a gradient."""
    rays = rays_towards_origin(16)
    sampler = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, min_weight=1e-4, pad_to=1).train()
    everything = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, pad_to=1).train()
    kept, samples = (s(rays, fog(0.3), generator=torch.Generator().manual_seed(0)) for s in (sampler, everything))
    # The box's edges may cut off a sliver too thin to weigh anything.
    assert torch.isin(samples.starts[samples.lengths > 0.01], kept.starts).all()


def test_occupancy_learns_from_the_samples_that_are_dropped() -> None:
    """The density of a dropped sample counts like that of a kept one."""
    sampler = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, 16, min_weight=1e-4).train()
    density: Callable[[Tensor], Tensor] = lambda x: torch.full_like(x[..., 0], 1e-3)  # noqa: E731
    samples = sampler(rays_towards_origin(64), FormulaField(density, lambda x, d, t: x))
    assert samples.starts.shape == (0,)
    assert bool((sampler.grid.maxima == 1e-3).any())


def test_evaluation_keeps_every_sample_in_occupied_cells() -> None:
    """Images without gradients end rays early while they are shaded; filtering before would evaluate twice."""
    rays = rays_towards_origin(64)
    plain, filtering = (occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, min_weight=w).eval() for w in (0.0, 1e-2))
    assert torch.equal(plain(rays, ball()).starts, filtering(rays, ball()).starts)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0, 1), max_size=200), st.integers(0, 1000))
def test_of_neighbours_as_many_are_taken_as_their_chances_add_up_to(chances: list[float], seed: int) -> None:
    taken = by_chance(torch.tensor(chances), torch.Generator().manual_seed(seed)).tolist()
    assert len(taken) == len(chances)
    for i in range(len(chances)):
        assert chances[i] > 0 or not taken[i]
        assert chances[i] < 1 or taken[i]
        assert abs(sum(taken[: i + 1]) - sum(chances[: i + 1])) < 1 + 1e-6


def test_each_is_taken_with_its_chance() -> None:
    chances = torch.tensor([0.1, 0.6, 0.0, 0.25, 1.0, 0.9])
    generator = torch.Generator().manual_seed(0)
    rates = torch.stack([by_chance(chances, generator) for _ in range(4000)]).float().mean(0)
    torch.testing.assert_close(rates, chances, rtol=0, atol=4 * 0.5 / math.sqrt(4000))  # four standard deviations


@pytest.mark.parametrize("is_fixed", [False, True])
def test_few_samples_of_thin_fog_stand_for_all(is_fixed: bool) -> None:
    """In the mean over rays the optical depth and its gradient are those of all samples, at a tenth of their number."""
    rays, box = rays_towards_origin(400), [[-1.0] * 3, [1.0] * 3]
    found = []
    for chance_weight in (0.0, 0.05):
        sampler = occupancy_sampler(box, 0.02, min_weight=1e-7, chance_weight=chance_weight, pad_to=1).train()
        density, generator = torch.tensor(0.2, requires_grad=True), torch.Generator().manual_seed(0)
        if is_fixed:
            samples = sampler.sample_fixed(rays, fog(0.2), Capacity(1 << 17, 1 << 17), generator=generator)
        else:
            samples = sampler(rays, fog(0.2), generator=generator)
        opacity = 1 - torch.exp(-sum_along_rays(density * samples.lengths, samples))
        (gradient,) = torch.autograd.grad(opacity.mean(), density)
        found.append((int((samples.lengths > 0).sum()), opacity.mean().item(), gradient.item()))
    (num_all, *exact), (num_few, *estimated) = found
    assert num_few < 0.1 * num_all
    # A sample stands for an opacity of 0.05; of about 0.3 along a ray half a sample is uncertain, on 400 rays.
    assert estimated == pytest.approx(exact, rel=0.01)


def test_what_weighs_more_is_taken_as_it_is() -> None:
    rays, box = rays_towards_origin(64), [[-1.0] * 3, [1.0] * 3]
    plain, lucky = (
        occupancy_sampler(box, 0.02, min_weight=1e-4, chance_weight=w, pad_to=1).train()(
            rays, ball(), generator=torch.Generator().manual_seed(0)
        )
        for w in (0.0, 0.02)
    )
    density = ball().density(plain.locate(rays)[0], plain.per_sample(rays.times))
    heavy = plain.kept(render_weights(density * plain.lengths, plain) >= 0.02)
    is_heavy = torch.isin(lucky.starts, heavy.starts)
    assert torch.equal(lucky.kept(is_heavy).ends, heavy.ends)
    assert 0 < len(heavy.starts) <= len(lucky.starts) < len(plain.starts)


def test_a_field_that_needs_the_ends_of_intervals_gets_all_of_them() -> None:
    class Thick(FormulaField, IntervalAware):
        def between(self, starts: Tensor, ends: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
            return self(0.5 * (starts + ends), directions, times)

    field = Thick(lambda x: torch.full_like(x[..., 0], 0.2), lambda x, d, t: x)
    plain, lucky = (
        occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, min_weight=1e-4, chance_weight=w).train()(
            rays_towards_origin(64), field, generator=torch.Generator().manual_seed(0)
        )
        for w in (0.0, 0.02)
    )
    assert torch.equal(plain.starts, lucky.starts)


def test_the_filter_evaluates_no_more_at_once_than_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    class Fog(FormulaField):
        def density(self, positions: Tensor, times: Tensor) -> Tensor:
            sizes.append(len(times))
            return torch.full_like(times, 1e-3)

    monkeypatch.setattr("dnerf.samplers.occupancy.MOST_AT_ONCE", 200)
    sampler = occupancy_sampler([[-1.0] * 3, [1.0] * 3], 0.02, min_weight=1e-7, pad_to=1).train()
    samples = sampler(rays_towards_origin(64), Fog(lambda x: x[..., 0], lambda x, d, t: x))
    assert samples.starts.numel() > 2000  # rays of some fifty intervals or more, all of them kept
    assert max(sizes) <= 200
