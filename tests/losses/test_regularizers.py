"""Losses against their formulas."""

import math
from dataclasses import replace

import pytest
import torch
from reference import fog, occupancy_sampler
from torch import Tensor

from dnerf.core.backgrounds import RandomBackground
from dnerf.core.compositing import FieldOutput, Rendering
from dnerf.core.rays import Samples
from dnerf.deformations import Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, PlaneFeatures, RadianceField, VoxelField
from dnerf.losses import Batch, DistortionLoss, PhotometricLoss, SmoothnessLoss, TimeEmbeddingLoss, UnseenSpaceLoss
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler

RENDERER = Renderer(fog(), StratifiedSampler(4))


def of(target: Tensor) -> Batch:
    return Batch(torch.cat([target, torch.ones_like(target[:, :1])], dim=-1), target)


def shown(rgb: Tensor, opacity: Tensor | None = None, proposals: tuple[Rendering, ...] = ()) -> Rendering:
    opacity = torch.ones(len(rgb)) if opacity is None else opacity
    return Rendering(rgb, opacity, torch.zeros(len(rgb)), proposals=proposals)


def test_squared_error_is_the_mean_over_rays_and_channels() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    expected = sum((a - b) ** 2 for a, b in zip(rgb.flatten().tolist(), target.flatten().tolist())) / 30
    assert PhotometricLoss()(shown(rgb), of(target), RENDERER).item() == pytest.approx(expected, rel=1e-6)


def test_error_before_any_background_is_the_mean_over_its_colours() -> None:
    generator = torch.Generator().manual_seed(0)
    colors, true = torch.rand(2, 10, 3, generator=generator, dtype=torch.float64)
    opacity, alpha = torch.rand(2, 10, generator=generator, dtype=torch.float64)
    rgba = torch.cat([true, alpha[:, None]], dim=-1)

    def loss_on(color: float, renderer: Renderer) -> float:
        rgb, target = colors + (1 - opacity[:, None]) * color, true + (1 - alpha[:, None]) * color
        return PhotometricLoss()(shown(rgb, opacity), Batch(rgba, target), renderer).item()

    # Simpson's rule is exact: the error is quadratic in the background's colour.
    mean = (loss_on(0.0, RENDERER) + 4 * loss_on(0.5, RENDERER) + loss_on(1.0, RENDERER)) / 6
    any_color = Renderer(fog(), StratifiedSampler(4), RandomBackground())
    assert loss_on(0.5, any_color) == pytest.approx(mean, rel=1e-12)


def test_rays_that_found_no_places_count_for_nothing() -> None:
    loss = PhotometricLoss()
    rgb, opacity, target = torch.rand(6, 3), torch.rand(6), torch.rand(6, 3)
    placed = torch.tensor([True, True, False, True, False, False])
    nothing = torch.zeros(0)
    samples = Samples(nothing, nothing, 6, ray_indices=nothing.long(), is_placed=placed)
    with_places = replace(shown(rgb, opacity), samples=samples)
    expected = loss(shown(rgb[placed], opacity[placed]), of(target[placed]), RENDERER)
    torch.testing.assert_close(loss(with_places, of(target), RENDERER), expected)


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_proposals_are_scored_with_their_weight(weight: float) -> None:
    rgb, coarse, target = torch.rand(3, 10, 3)
    loss = PhotometricLoss(proposal_weight=weight)(shown(rgb, proposals=(shown(coarse),)), of(target), RENDERER)
    expected = (rgb - target).square().mean() + weight * (coarse - target).square().mean()
    torch.testing.assert_close(loss, expected)


def test_gradcheck_of_the_error() -> None:
    target = torch.rand(3, 3, dtype=torch.float64)
    rgb, opacity = torch.rand(3, 3, dtype=torch.float64), torch.rand(3, dtype=torch.float64)
    renderer = Renderer(fog(), StratifiedSampler(4), RandomBackground())
    assert torch.autograd.gradcheck(
        lambda x, o: PhotometricLoss()(shown(x, o), of(target), renderer),
        (rgb.requires_grad_(), opacity.requires_grad_()),
    )


def test_bad_photometric_loss_is_refused() -> None:
    with pytest.raises(ValueError, match="proposal_weight must be >= 0"):
        PhotometricLoss(proposal_weight=-1.0)


class Level(RadianceField):
    """Fog whose density is a parameter."""

    def __init__(self, density: float) -> None:
        super().__init__()
        self.level = torch.nn.Parameter(torch.tensor(density))
        self.evaluated: list[tuple[Tensor, Tensor]] = []

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        self.evaluated.append((positions, times))
        return self.level.expand(times.shape)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.zeros_like(positions))


class Shift(Deformation):
    """Everything moves by half a unit along x."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions + torch.tensor([0.5, 0.0, 0.0])


BOX = [[-1.0] * 3, [1.0] * 3]


def guided(density: float = 30.0, deformation: Deformation | None = None) -> Renderer:
    sampler = occupancy_sampler(BOX, 0.02, 8, num_slabs=2)
    return Renderer(DeformedField(deformation or IdentityDeformation(), Level(density)), sampler)


def seen_at(positions: Tensor, weights: Tensor) -> Rendering:
    """An image of samples at canonical positions with shares in it."""
    output = FieldOutput(weights, torch.zeros(len(weights), 3), {"canonical_positions": positions})
    return Rendering(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1), weights=weights, output=output)


NOTHING = seen_at(torch.zeros(0, 3), torch.zeros(0))
TARGET = of(torch.zeros(1, 3))


def test_unseen_space_costs_the_opacity_of_an_interval() -> None:
    loss = UnseenSpaceLoss(BOX, num_points=100, length=0.1)(NOTHING, TARGET, guided(30.0))
    assert loss.item() == pytest.approx(-math.expm1(-3.0), rel=1e-6)


def test_unseen_space_is_emptied_unless_it_is_opaque() -> None:
    for density, expected in ((0.0, 0.1), (30.0, 0.1 * math.exp(-3.0)), (1e4, 0.0)):
        renderer = guided(density)
        UnseenSpaceLoss(BOX, 1.0, length=0.1)(NOTHING, TARGET, renderer).backward()
        assert renderer.field.canonical.level.grad.item() == pytest.approx(expected, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("batch", [1, 4])
def test_what_is_seen_in_canonical_space_costs_nothing_until_it_is_forgotten(batch: int) -> None:
    """Half of canonical space is seen once, through a deformation that shifts by a quarter of the box."""
    centers = torch.cartesian_prod(*[torch.arange(-0.75, 1.0, 0.5)] * 3)
    half = centers[centers[:, 0] > 0].repeat(batch, 1)
    renderer = guided(30.0, Shift())
    loss = UnseenSpaceLoss(BOX, 1.0, 4000, length=0.1, resolution=4, memory_samples=4 * 32)
    opacity = -math.expm1(-3.0)
    # World x in [-1, 1] is canonical [-0.5, 1.5]; above 0 is three quarters, and what is beyond counts as at the face.
    for expected in [0.25] * (1 + 4 // batch) + [1.0]:
        shown = seen_at(half, torch.full((len(half),), 0.5 if loss.num_calls == 0 else 0.0))
        assert loss(shown, TARGET, renderer).item() == pytest.approx(expected * opacity, rel=0.1)


def test_a_share_too_small_to_see_does_not_count_as_seen() -> None:
    centers = torch.cartesian_prod(*[torch.arange(-0.75, 1.0, 0.5)] * 3)
    loss = UnseenSpaceLoss(BOX, 1.0, resolution=4, length=0.1)
    value = loss(seen_at(centers, torch.full((64,), 1e-4)), TARGET, guided(30.0))
    assert value.item() == pytest.approx(-math.expm1(-3.0), rel=1e-6)
    assert loss(seen_at(centers, torch.full((64,), 1e-2)), TARGET, guided(30.0)) == 0


def test_no_gradient_of_unseen_space_reaches_the_deformation() -> None:
    deformation = DisplacementDeformation(1, 8, ())
    torch.nn.init.normal_(deformation.mlp.output.weight)
    renderer = Renderer(DeformedField(deformation, GridField(BOX, [4, 8])), occupancy_sampler(BOX, 0.02, 8))
    UnseenSpaceLoss(BOX)(NOTHING, TARGET, renderer).backward()
    assert all(p.grad is None for p in deformation.parameters())
    assert renderer.field.canonical.table.grad.abs().sum() > 0


def test_unseen_space_is_sought_in_occupied_cells_and_elsewhere_each_time() -> None:
    renderer = guided()
    mask = torch.zeros_like(renderer.sampler.grid.occupied)
    mask[1, 2, 3, 4] = True
    renderer.sampler.grid.occupy(mask)
    loss = UnseenSpaceLoss(BOX)
    loss(NOTHING, TARGET, renderer)
    again = UnseenSpaceLoss(BOX)
    again.load_state_dict(loss.state_dict())
    for each in (loss, again):
        each(NOTHING, TARGET, renderer)
    evaluated = renderer.field.canonical.evaluated
    lowest = torch.tensor([-0.5, -0.25, 0.0])
    for positions, times in evaluated:
        assert positions.shape == (1024, 3)
        assert ((positions >= lowest) & (positions <= lowest + 0.25)).all()
        assert ((times >= 0.5) & (times <= 1)).all()
    assert not torch.equal(evaluated[0][0], evaluated[1][0])
    assert torch.equal(evaluated[1][0], evaluated[2][0])


@pytest.mark.parametrize(
    "setting", [{"weight": -1.0}, {"num_points": 0}, {"length": 0.0}, {"resolution": 0}, {"memory_samples": 0}]
)
def test_bad_settings_of_unseen_space_are_named(setting: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(setting))):
        UnseenSpaceLoss(BOX, **setting)


def test_unseen_space_needs_a_deformed_field_and_a_sampler_that_knows_cells() -> None:
    renderer = guided()
    loss = UnseenSpaceLoss()
    loss.check(renderer)
    assert torch.equal(loss.box, renderer.sampler.grid.box)  # the sampler's, where none is given
    with pytest.raises(ValueError, match="UnseenSpaceLoss needs a deformed field, got FormulaField"):
        loss.check(RENDERER)
    with pytest.raises(ValueError, match="UnseenSpaceLoss needs an occupancy-aware sampler, got StratifiedSampler"):
        loss.check(Renderer(renderer.field, StratifiedSampler(4)))


def test_rough_planes_cost() -> None:
    planes = PlaneFeatures(BOX, (4,), 1)
    field = DeformedField(IdentityDeformation(), GridField(BOX, (4,), 2, space_time=planes))
    renderer, rgb = Renderer(field, StratifiedSampler(4)), torch.zeros(2, 3)
    SmoothnessLoss().check(renderer)
    in_space, in_time = (float(x.detach()) for x in planes.roughness())
    assert in_space > 0 == in_time  # two times have no second difference
    loss = SmoothnessLoss(time_weight=7.0)(shown(rgb), of(rgb), renderer)
    assert loss.item() == pytest.approx(in_space)
    assert torch.autograd.grad(loss, planes.tables[0])[0].abs().sum() > 0
    with pytest.raises(ValueError, match="SmoothnessLoss needs a field with a part of `HasRoughness`"):
        SmoothnessLoss().check(RENDERER)
    with pytest.raises(ValueError, match="time_weight must be >= 0"):
        SmoothnessLoss(time_weight=-1.0)


def test_layers_of_voxels_that_cost_go_on_where_a_loss_that_is_loaded_was() -> None:
    field = VoxelField(BOX, (40,), view_degree=0)
    with torch.no_grad():
        field.tables[0].copy_(torch.arange(len(field.tables[0]))[:, None] ** 2)
    renderer, rgb = Renderer(field, StratifiedSampler(4)), torch.zeros(2, 3)
    loss, resumed = SmoothnessLoss(), SmoothnessLoss()
    costs = [loss(shown(rgb), of(rgb), renderer).item() for _ in range(4)]
    assert len(set(costs)) == 4
    resumed.load_state_dict(loss.state_dict())
    assert resumed(shown(rgb), of(rgb), renderer).item() == loss(shown(rgb), of(rgb), renderer).item()


def of_embeddings(values: list[float]) -> tuple[Renderer, torch.nn.Parameter]:
    """A model whose deformation has learnt one feature of as many times, and these."""
    deformation = DisplacementDeformation(1, 8, (), time_embeddings=len(values))
    embeddings = deformation.encode_times.embeddings
    assert embeddings is not None
    with torch.no_grad():
        embeddings.copy_(torch.tensor(values)[:, None].expand_as(embeddings))
    return Renderer(DeformedField(deformation, fog()), StratifiedSampler(4)), embeddings


def test_embeddings_of_which_images_say_nothing_are_between_their_neighbours_or_as_the_last() -> None:
    renderer, embeddings = of_embeddings([0.5, 0.0, 0.0, 2.0, 0.0, 0.0])
    rgb = torch.rand(2, 3)
    loss = TimeEmbeddingLoss(rays_per_embedding=None)
    assert loss(shown(rgb), of(rgb), renderer).item() == pytest.approx((0.25 + 4.0 + 4.0) / 5, rel=1e-6)
    optimizer = torch.optim.Adam([embeddings], lr=0.02)
    for _ in range(600):
        optimizer.zero_grad()
        loss(shown(rgb), of(rgb), renderer).backward()
        assert embeddings.grad is not None
        embeddings.grad[[0, 3]] = 0.0  # as those whose frames keep them where they are
        optimizer.step()
    expected = torch.tensor([0.5, 1.0, 1.5, 2.0, 2.0, 2.0])
    torch.testing.assert_close(embeddings.detach()[:, 0], expected, rtol=0, atol=0.02)


def test_the_longer_times_are_looked_at_the_smoother_they_have_to_be() -> None:
    """In proportion to rays, from a number for each embedding on: 6 embeddings of 5 rays each, 2 rays a call."""
    renderer, _ = of_embeddings([0.5, 0.0, 0.0, 2.0, 0.0, 0.0])
    rgb = torch.rand(2, 3)
    loss = TimeEmbeddingLoss(rays_per_embedding=5)
    found = [loss(shown(rgb), of(rgb), renderer).item() for _ in range(60)]
    expected = [max(1, 2 * (call + 1) / 30) * 8.25 / 5 for call in range(60)]
    assert found == pytest.approx(expected, rel=1e-5)
    going_on = TimeEmbeddingLoss(rays_per_embedding=5)
    going_on.load_state_dict(loss.state_dict())
    assert going_on(shown(rgb), of(rgb), renderer).item() == pytest.approx(122 / 30 * 8.25 / 5, rel=1e-5)


def test_a_model_without_embeddings_is_named_before_training() -> None:
    TimeEmbeddingLoss().check(of_embeddings([0.0, 1.0])[0])
    assert DisplacementDeformation(1, 8, ()).encode_times.roughness().item() == 0
    with pytest.raises(ValueError, match="TimeEmbeddingLoss needs learnt time embeddings, this model has none"):
        TimeEmbeddingLoss().check(RENDERER)
    with pytest.raises(ValueError, match="weight must be >= 0"):
        TimeEmbeddingLoss(-1.0)
    with pytest.raises(ValueError, match="rays_per_embedding must be"):
        TimeEmbeddingLoss(rays_per_embedding=0)


def spread_of(weights: Tensor, samples: Samples) -> Tensor:
    rgb = weights.new_zeros(samples.num_rays, 3)
    rendering = Rendering(rgb, rgb[:, 0], rgb[:, 0], weights=weights, samples=samples)
    return DistortionLoss()(rendering, of(rgb), RENDERER)


def some_samples(is_packed: bool) -> tuple[Tensor, Samples]:
    """Weights of five samples on each of three rays; packed ones are none, two and all of a ray's."""
    generator = torch.Generator().manual_seed(0)
    ends = torch.rand(3, 5, dtype=torch.float64, generator=generator).cumsum(-1)
    lengths = 0.9 * ends.diff(dim=-1, prepend=ends.new_zeros(3, 1))
    weights = 0.3 * torch.rand(3, 5, dtype=torch.float64, generator=generator)
    if not is_packed:
        return weights, Samples(ends - lengths, ends, 3)
    kept = torch.tensor([[False] * 5, [True, True, False, False, False], [True] * 5])
    rays = kept.nonzero()[:, 0]
    return weights[kept], Samples((ends - lengths)[kept], ends[kept], 3, ray_indices=rays)


@pytest.mark.parametrize("is_packed", [False, True])
def test_distortion_is_the_sum_over_all_pairs_of_samples(is_packed: bool) -> None:
    weights, samples = some_samples(is_packed)
    rays = torch.arange(3).repeat_interleave(5) if samples.ray_indices is None else samples.ray_indices
    flat, places, lengths = (x.reshape(-1) for x in (weights.requires_grad_(), samples.distances, samples.lengths))
    expected = torch.zeros((), dtype=torch.float64)
    for ray in range(3):
        mine = [i for i, number in enumerate(rays.tolist()) if number == ray]
        apart = (places[mine, None] - places[mine]).abs() + torch.diag(lengths[mine]) / 3
        opacity = flat[mine].sum().clamp(min=1e-30)
        expected = expected + flat[mine] @ apart @ flat[mine] / opacity**2 * opacity.detach() / 3
    found = spread_of(weights, samples)
    assert found.item() == pytest.approx(expected.item(), rel=1e-12)
    slopes, true_slopes = (torch.autograd.grad(value, weights)[0] for value in (found, expected))
    assert torch.allclose(slopes, true_slopes, rtol=1e-9, atol=0)
    assert (slopes * weights).sum().abs().item() < 1e-15  # more light costs nothing: none is driven out of the box


def test_distortion_of_one_thin_opaque_place_and_of_nothing_is_zero() -> None:
    weights = torch.tensor([[0.0, 1.0, 0.0]])
    starts = torch.tensor([[1.0, 2.0, 3.0]])
    assert spread_of(weights, Samples(starts, starts + 1e-6, 1)).item() < 1e-6
    nothing = torch.zeros(0)
    assert spread_of(nothing, Samples(nothing, nothing, 2, ray_indices=nothing.long())).item() == 0.0
