"""Importance sampling: fine samples go where the coarse pass finds density; only an own proposal is trained."""

import pytest
import torch
from reference import FormulaField, rays_towards_origin, soft_ball
from torch import Tensor

from dnerf.core.compositing import composite
from dnerf.fields import FieldOutput, NeRFField, RadianceField
from dnerf.losses import Batch, PhotometricLoss
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import ImportanceSampler, Sampler, StratifiedSampler


class Shell(RadianceField):
    """A thin opaque shell of radius 1, that lists what is evaluated."""

    def __init__(self) -> None:
        super().__init__()
        self.evaluated: list[str] = []

    def _density(self, positions: Tensor) -> Tensor:
        return 100 * torch.exp(-0.5 * ((positions.norm(dim=-1) - 1) / 0.05) ** 2)

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        self.evaluated.append("density")
        return self._density(positions)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        self.evaluated.append("all")
        return FieldOutput(self._density(positions), torch.ones_like(positions))


def small_nerf() -> NeRFField:
    return NeRFField(2, 16, (), position_frequencies=2)


def test_fine_samples_gather_where_the_weight_is() -> None:
    rays = rays_towards_origin(40, torch.float64)
    hits = torch.linalg.cross(rays.origins, rays.directions).norm(dim=-1) < 0.9
    samples = ImportanceSampler(64, 64).eval()(rays, Shell())
    distances = samples.locate(rays)[0].norm(dim=-1)
    near_shell = ((distances - 1).abs() < 0.15) & (samples.distances < 3.5)
    share = near_shell.double().mean(-1)[hits]
    # All 64 drawn edges and the few coarse ones there: half of the samples, on a twentieth of the ray.
    assert hits.sum() > 10
    assert (share > 0.45).all()


def test_there_are_as_many_intervals_as_evaluated_for_and_they_cover_the_ray() -> None:
    samples = ImportanceSampler(8, 12).eval()(rays_towards_origin(5), soft_ball())
    assert samples.starts.shape == (5, 20)
    assert torch.equal(samples.starts[:, 1:], samples.ends[:, :-1])
    assert (samples.starts[:, 0] == 1).all()
    assert (samples.ends[:, -1] == 5).all()


def test_importance_sampling_finds_a_surface_better_than_equal_intervals() -> None:
    rays = rays_towards_origin(300, torch.float64)
    ball = FormulaField(lambda x: 200.0 * (x.norm(dim=-1) < 0.5), lambda x, d, t: x)

    def depth(sampler: Sampler) -> Tensor:
        samples = sampler.eval()(rays, ball)
        return composite(samples, ball(samples.locate(rays)[0], rays.directions, samples.distances)).depth

    half_chord = (0.5**2 - torch.linalg.cross(rays.origins, rays.directions).square().sum(-1)).clamp(min=0).sqrt()
    hits = half_chord > 0.1
    surface = -(rays.origins * rays.directions).sum(-1) - half_chord
    equal, importance = (
        (depth(sampler) - surface)[hits].abs().mean().item()
        for sampler in (StratifiedSampler(64), ImportanceSampler(32, 32))
    )
    assert hits.sum() > 50
    # An interval of 1/16 misses the surface by a quarter of itself on average.
    assert equal > 1 / 100
    # Fine samples find it unless it lies behind the middle of its coarse interval, which then has no weight.
    assert importance < 0.75 * equal


def test_shared_network_is_evaluated_for_density_alone_without_gradient() -> None:
    shell = Shell()
    samples = ImportanceSampler(8, 8)(rays_towards_origin(3), shell)
    assert shell.evaluated == ["density"]
    assert samples.proposals == ()


def test_own_proposal_is_evaluated_instead_of_the_field() -> None:
    field, proposal = Shell(), Shell()
    samples = ImportanceSampler(8, 8, proposal)(rays_towards_origin(3), field)
    assert (field.evaluated, proposal.evaluated) == ([], ["all"])
    ((coarse, output),) = samples.proposals
    assert coarse.starts.shape == output.density.shape == (3, 8)


@pytest.mark.parametrize("own", [True, False])
def test_only_an_own_proposal_is_trained_by_the_coarse_image(own: bool) -> None:
    field, proposal = small_nerf(), small_nerf() if own else None
    renderer = Renderer(field, ImportanceSampler(8, 8, proposal))
    rendering = renderer(rays_towards_origin(20), generator=torch.Generator().manual_seed(0))
    assert len(rendering.proposals) == own
    PhotometricLoss()(rendering, Batch(torch.rand(20, 4), torch.rand(20, 3)), renderer).backward()
    assert all(torch.count_nonzero(p.grad) for p in field.parameters())
    if proposal is not None:
        assert all(torch.count_nonzero(p.grad) for p in proposal.parameters())


def test_placing_samples_sends_no_gradient() -> None:
    """With the coarse images' weight at zero, an own proposal must not be pulled by the fine image."""
    proposal = small_nerf()
    renderer = Renderer(small_nerf(), ImportanceSampler(8, 8, proposal))
    rendering = renderer(rays_towards_origin(20))
    batch = Batch(torch.rand(20, 4), torch.rand(20, 3))
    PhotometricLoss(proposal_weight=0)(rendering, batch, renderer).backward()
    assert not any(torch.count_nonzero(p.grad) for p in proposal.parameters() if p.grad is not None)


@pytest.mark.parametrize(("counts", "name"), [((0, 8), "num_samples"), ((8, 0), "num_fine")])
def test_numbers_must_be_positive(counts: tuple[int, int], name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be > 0"):
        ImportanceSampler(*counts)
