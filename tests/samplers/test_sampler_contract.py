"""What every sampler must do. A new one is one line in `SAMPLERS`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from reference import fog, occupancy_sampler, rays_towards_origin, soft_ball

from dnerf.core.compositing import composite
from dnerf.core.rays import Rays, Samples
from dnerf.fields import NeuSField, RadianceField
from dnerf.samplers import ImportanceSampler, ProposalSampler, Sampler, SphereTracingSampler, StratifiedSampler

BOX = torch.tensor([[-1.0, -1.2, -0.8], [0.9, 1.1, 1.3]])


def filled_occupancy() -> Sampler:
    sampler = occupancy_sampler(BOX.tolist(), 0.05, 16, num_slabs=2)
    sampler.grid.fill(soft_ball())
    return sampler


SAMPLERS: dict[str, Callable[[], Sampler]] = {
    "stratified": lambda: StratifiedSampler(16),
    "stratified, one sample": lambda: StratifiedSampler(1),
    "stratified in a box": lambda: StratifiedSampler(16, BOX),
    "importance, shared network": lambda: ImportanceSampler(8, 12),
    "importance, own proposal": lambda: ImportanceSampler(8, 12, soft_ball(width=0.6)),
    "occupancy, all of a box": lambda: occupancy_sampler(BOX.tolist(), 0.1, 8, num_slabs=4),
    "occupancy, filled": filled_occupancy,
    "proposal": lambda: ProposalSampler([soft_ball(width=0.6), soft_ball()], (8, 8), 8),
    "proposal, one interval": lambda: ProposalSampler([soft_ball()], (1,), 1),
    "proposal in a box": lambda: ProposalSampler([soft_ball()], (8,), 8, box=BOX, min_weight=0.0),
    "importance in a box": lambda: ImportanceSampler(8, 12, box=BOX),
    "sphere tracing": lambda: SphereTracingSampler(BOX),
}

every_sampler = pytest.mark.parametrize("name", SAMPLERS)
both_modes = pytest.mark.parametrize("training", [False, True])


@dataclass(frozen=True)
class Interval:
    """One sample of one ray."""

    start: float
    end: float
    point: float


def intervals(samples: Samples) -> list[list[Interval]]:
    """Each ray's samples in order, whatever the layout."""
    rays: list[list[Interval]] = [[] for _ in range(samples.num_rays)]
    table = samples if samples.is_packed else samples.packed()
    assert table.ray_indices is not None
    columns = (table.ray_indices, table.starts, table.ends, table.distances)
    for r, *numbers in zip(*(column.tolist() for column in columns)):
        rays[r].append(Interval(*numbers))
    return rays


def ball(name: str, dtype: torch.dtype) -> RadianceField:
    """A soft ball, or one with a surface for the sampler that looks for it."""
    if name != "sphere tracing":
        return soft_ball()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return NeuSField(BOX.tolist(), (4,), 2, max_rows=64, hidden_features=8, num_layers=1, radius=0.7).to(dtype)


def sample(name: str, rays: Rays, training: bool = False, seed: int = 0) -> Samples:
    """Samples of a ball's rays; a fresh sampler each time, so that nothing is carried over."""
    sampler = SAMPLERS[name]().train(training)
    return sampler(rays, ball(name, rays.origins.dtype), generator=torch.Generator().manual_seed(seed))


@every_sampler
@both_modes
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_intervals_are_ordered_and_lie_within_the_ray(name: str, training: bool, dtype: torch.dtype) -> None:
    rays = rays_towards_origin(50, dtype)
    samples = sample(name, rays, training)
    assert samples.num_rays == 50
    assert samples.starts.dtype == dtype
    for row, near, far in zip(intervals(samples), rays.near.tolist(), rays.far.tolist(), strict=True):
        ends = [near]
        for interval in row:
            assert ends[-1] <= interval.start <= interval.point <= interval.end <= far
            ends.append(interval.end)


@every_sampler
@both_modes
@pytest.mark.parametrize("length", [1e-7, 1e-5, 1e-3, 1e3])
def test_no_interval_is_negative_on_very_short_and_long_rays(name: str, training: bool, length: float) -> None:
    rays = rays_towards_origin(50)
    rays = Rays(rays.origins, rays.directions, rays.times, 2 + rays.times, 2 + rays.times + length)
    samples = sample(name, rays, training)
    assert (samples.lengths >= 0).all()
    assert (samples.distances >= samples.starts).all()
    assert (samples.distances <= samples.ends).all()


@every_sampler
def test_ray_indices_are_sorted(name: str) -> None:
    samples = sample(name, rays_towards_origin(50))
    if samples.ray_indices is not None:
        assert samples.ray_indices.dtype == torch.int64
        assert (samples.ray_indices.diff() >= 0).all()


@every_sampler
@both_modes
@pytest.mark.parametrize("length", [0.0, -1.0])
def test_empty_ray_shows_background(name: str, training: bool, length: float) -> None:
    rays = rays_towards_origin(6)
    rays = Rays(rays.origins, rays.directions, rays.times, rays.near, rays.near + length)
    samples = sample(name, rays, training)
    output = fog(1e6)(samples.locate(rays)[0], samples.per_sample(rays.directions), samples.per_sample(rays.times))
    background = torch.rand(6, 3)
    rendering = composite(samples, output, background)
    assert torch.equal(rendering.rgb, background)
    assert torch.equal(rendering.opacity, torch.zeros(6))


@every_sampler
@both_modes
def test_no_rays_give_no_samples(name: str, training: bool) -> None:
    samples = sample(name, rays_towards_origin(6)[:0], training)
    assert samples.num_rays == 0
    assert samples.starts.numel() == 0


@every_sampler
def test_evaluation_is_deterministic(name: str) -> None:
    rays = rays_towards_origin(30)
    assert intervals(sample(name, rays, seed=0)) == intervals(sample(name, rays, seed=1))


@every_sampler
def test_evaluation_leaves_the_random_numbers_alone(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    before = generator.get_state()
    SAMPLERS[name]().eval()(rays_towards_origin(5), ball(name, torch.float32), generator=generator)
    assert torch.equal(generator.get_state(), before)


@every_sampler
def test_training_follows_its_generator(name: str) -> None:
    rays = rays_towards_origin(30)
    first, again, other = (intervals(sample(name, rays, training=True, seed=seed)) for seed in (1, 1, 2))
    assert first == again
    assert (first == other) == (name == "sphere tracing")  # which draws nothing


@every_sampler
def test_training_uses_no_randomness_but_its_generator(name: str) -> None:
    before = torch.random.get_rng_state()
    sample(name, rays_towards_origin(5), training=True)
    assert torch.equal(torch.random.get_rng_state(), before)


@every_sampler
def test_rays_do_not_see_each_other(name: str) -> None:
    rays = rays_towards_origin(12, torch.float64)
    together = intervals(sample(name, rays))
    backward = intervals(sample(name, rays[torch.arange(11, -1, -1)]))
    for r in range(12):
        # Padding by intervals of length zero, which add nothing, may go to any ray.
        alone = [i for i in intervals(sample(name, rays[r : r + 1]))[0] if i.end > i.start]
        for given in (together[r], backward[11 - r]):
            row = [i for i in given if i.end > i.start]
            assert len(row) == len(alone)
            for a, b in zip(row, alone):
                assert (a.start, a.end, a.point) == pytest.approx((b.start, b.end, b.point), rel=1e-12)


def shown(name: str, rays: Rays, training: bool, samples: Samples | None = None) -> torch.Tensor:
    """Colours (R, 3) of a soft ball's rays, at samples of their own or at given ones."""
    samples = sample(name, rays, training) if samples is None else samples
    return composite(samples, soft_ball()(*samples.locate(rays))).rgb


@pytest.mark.parametrize("name", ["stratified", "stratified, one sample", "stratified in a box"])
@both_modes
def test_stratified_gradients_to_rays_are_those_of_what_is_rendered(name: str, training: bool) -> None:
    """Also where a box cuts rays off: camera poses may be fitted by them."""
    rays = rays_towards_origin(4, torch.float64)

    def render(origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        return shown(name, replace(rays, origins=origins, directions=directions), training)

    leaves = rays.origins.clone().requires_grad_(), rays.directions.clone().requires_grad_()
    assert torch.autograd.gradcheck(render, leaves)


@every_sampler
@both_modes
def test_other_samplers_hold_distances_fixed(name: str, training: bool) -> None:
    """Their gradients to rays are those of the same samples, wherever these would have moved."""
    if name.startswith("stratified"):
        pytest.skip("its samples move with the rays")
    rays = rays_towards_origin(6, torch.float64)
    held = sample(name, rays, training)
    held = replace(held, starts=held.starts.detach(), ends=held.ends.detach(), points=held.distances.detach())
    found = []
    for samples in (None, held):
        origins = rays.origins.clone().requires_grad_()
        shown(name, replace(rays, origins=origins), training, samples).sum().backward()
        found.append(origins.grad)
    if name == "importance in a box":  # whose coarse edges end where the box does
        assert not torch.equal(*found)
        return
    torch.testing.assert_close(*found, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in SAMPLERS if "box" in name])
@both_modes
def test_samples_stay_in_the_box_and_cover_it(name: str, training: bool) -> None:
    rays = rays_towards_origin(200, torch.float64)
    samples = sample(name, rays, training)
    box = BOX.double()
    for row, origin, direction in zip(intervals(samples), rays.origins, rays.directions):
        row = [interval for interval in row if interval.end > interval.start]
        distances = torch.linspace(1, 5, 2001, dtype=torch.float64)
        points = origin + distances[:, None] * direction
        inside = ((points >= box[0]) & (points <= box[1])).all(-1)
        assert bool(inside.any()) or not row
        if row and inside.any():
            # To the spacing of the brute-force points, 0.002.
            assert row[0].start == pytest.approx(distances[inside][0].item(), abs=0.0021)
            assert row[-1].end == pytest.approx(distances[inside][-1].item(), abs=0.0021)
