"""Losses against their formulas."""

import math
from dataclasses import replace

import pytest
import torch
from reference import fog
from torch import Tensor

from dnerf.compositing import FieldOutput, Rendering
from dnerf.deformations import Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, RadianceField, SpaceTimeVolumes
from dnerf.losses import (
    FadingLoss,
    HiddenMatterLoss,
    Loss,
    OpacityEntropyLoss,
    PhotometricLoss,
    SmoothKnotsLoss,
    SmoothVolumesLoss,
)
from dnerf.rays import Samples
from dnerf.renderer import Renderer
from dnerf.samplers import OccupancySampler, StratifiedSampler

RENDERER = Renderer(fog(), StratifiedSampler(4))


def picture(rgb: Tensor, opacity: Tensor | None = None, proposals: tuple[Rendering, ...] = ()) -> Rendering:
    opacity = torch.ones(len(rgb)) if opacity is None else opacity
    return Rendering(rgb, opacity, torch.zeros(len(rgb)), proposals=proposals)


def test_squared_error_is_the_mean_over_rays_and_channels() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    expected = sum((a - b) ** 2 for a, b in zip(rgb.flatten().tolist(), target.flatten().tolist())) / 30
    assert PhotometricLoss()(picture(rgb), target, RENDERER).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("loss", [PhotometricLoss(), PhotometricLoss("huber"), OpacityEntropyLoss(1.0)])
def test_rays_that_found_no_places_count_for_nothing(loss: Loss) -> None:
    rgb, opacity, target = torch.rand(6, 3), torch.rand(6), torch.rand(6, 3)
    placed = torch.tensor([True, True, False, True, False, False])
    nothing = torch.zeros(0)
    samples = Samples(nothing, nothing, 6, ray_indices=nothing.long(), is_placed=placed)
    shown = replace(picture(rgb, opacity), samples=samples)
    expected = loss(picture(rgb[placed], opacity[placed]), target[placed], RENDERER)
    torch.testing.assert_close(loss(shown, target, RENDERER), expected)


def test_huber_error_is_quadratic_then_linear() -> None:
    loss = PhotometricLoss("huber", delta=0.1)
    target = torch.zeros(1, 3)
    small = loss(picture(torch.full((1, 3), 0.05)), target, RENDERER)
    large = loss(picture(torch.full((1, 3), 0.5)), target, RENDERER)
    assert small.item() == pytest.approx(0.05**2, rel=1e-6)
    assert large.item() == pytest.approx(2 * 0.1 * (0.5 - 0.05), rel=1e-6)


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_proposals_are_scored_with_their_weight(weight: float) -> None:
    rgb, coarse, target = torch.rand(3, 10, 3)
    loss = PhotometricLoss(proposal_weight=weight)(picture(rgb, proposals=(picture(coarse),)), target, RENDERER)
    expected = (rgb - target).square().mean() + weight * (coarse - target).square().mean()
    torch.testing.assert_close(loss, expected)


def test_a_term_fades_by_equal_ratios() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    full = PhotometricLoss()(picture(rgb), target, RENDERER).item()
    loss = FadingLoss(PhotometricLoss(), begin=0.2, end=0.6, share=0.01)
    for progress, factor in ((0.0, 1), (0.2, 1), (0.3, 0.01**0.25), (0.4, 0.1), (0.6, 0.01), (1.0, 0.01), (0.1, 1)):
        loss.set_progress(progress)
        assert loss(picture(rgb), target, RENDERER).item() == pytest.approx(factor * full, rel=1e-5)


def test_a_term_that_has_not_been_told_counts_in_full() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    expected = PhotometricLoss()(picture(rgb), target, RENDERER)
    assert FadingLoss(PhotometricLoss())(picture(rgb), target, RENDERER) == expected


def test_what_fades_within_what_fades_is_told_too() -> None:
    rgb, target = torch.rand(10, 3), torch.rand(10, 3)
    full = PhotometricLoss()(picture(rgb), target, RENDERER).item()
    loss = FadingLoss(FadingLoss(PhotometricLoss(), share=0.1), share=0.2)
    loss.set_progress(1.0)
    assert loss(picture(rgb), target, RENDERER).item() == pytest.approx(0.02 * full, rel=1e-5)


def test_only_a_loss_fades() -> None:
    with pytest.raises(ValueError, match="loss must be a Loss, got NoneType"):
        FadingLoss(None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"begin": 0.7}, "begin < end <= 1, got 0.7 and 0.7"),
        ({"begin": -0.1}, "0 <= begin"),
        ({"end": 1.5}, "end <= 1"),
        ({"begin": math.nan}, "0 <= begin"),
        ({"share": 0.0}, r"share must be in \(0, 1\], got 0.0"),
        ({"share": 2.0}, "share must be in"),
    ],
)
def test_bad_settings_of_what_fades_are_named(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FadingLoss(PhotometricLoss(), **settings)


def test_entropy_is_that_of_a_coin() -> None:
    opacity = torch.tensor([0.5, 0.25])
    loss = OpacityEntropyLoss(0.1)(picture(torch.zeros(2, 3), opacity), torch.zeros(2, 3), RENDERER)
    quarter = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    assert loss.item() == pytest.approx(0.1 * (math.log(2) + quarter) / 2, rel=1e-6)


def test_entropy_has_finite_gradients_at_clear_and_opaque_rays() -> None:
    opacity = torch.tensor([0.0, 1.0, 1e-30, 0.5], requires_grad=True)
    OpacityEntropyLoss(1.0)(picture(torch.zeros(4, 3), opacity), torch.zeros(4, 3), RENDERER).backward()
    assert torch.isfinite(opacity.grad).all()


def test_gradcheck_of_losses() -> None:
    target = torch.rand(3, 3, dtype=torch.float64)
    rgb = torch.rand(3, 3, dtype=torch.float64, requires_grad=True)
    opacity = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64, requires_grad=True)
    for loss in (PhotometricLoss(), PhotometricLoss("huber"), OpacityEntropyLoss(1.0)):
        assert torch.autograd.gradcheck(lambda a, b: loss(picture(a, b), target, RENDERER), (rgb, opacity))  # noqa: B023


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "l1"}, "kind must be one of mse, huber; got 'l1'"),
        ({"kind": "huber", "delta": 0.0}, "delta must be > 0"),
        ({"proposal_weight": -1.0}, "proposal_weight must be >= 0"),
    ],
)
def test_bad_photometric_loss_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhotometricLoss(**arguments)


def test_negative_entropy_weight_is_refused() -> None:
    with pytest.raises(ValueError, match="weight must be >= 0"):
        OpacityEntropyLoss(-1e-3)


class Level(RadianceField):
    """Fog whose density is a parameter."""

    def __init__(self, density: float) -> None:
        super().__init__()
        self.level = torch.nn.Parameter(torch.tensor(density))
        self.asked: list[tuple[Tensor, Tensor]] = []

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        self.asked.append((positions, times))
        return self.level.expand(times.shape)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.zeros_like(positions))


class Shift(Deformation):
    """Everything moves by half a unit along x."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions + torch.tensor([0.5, 0.0, 0.0])


BOX = [[-1.0] * 3, [1.0] * 3]


def guided(density: float = 30.0, deformation: Deformation | None = None) -> Renderer:
    sampler = OccupancySampler(BOX, 0.02, 8, num_slabs=2)
    return Renderer(DeformedField(deformation or IdentityDeformation(), Level(density)), sampler)


def seen_at(positions: Tensor, weights: Tensor) -> Rendering:
    """A picture of samples at canonical positions with shares in it."""
    output = FieldOutput(weights, torch.zeros(len(weights), 3), {"canonical_positions": positions})
    return Rendering(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1), weights=weights, output=output)


NOTHING = seen_at(torch.zeros(0, 3), torch.zeros(0))
TARGET = torch.zeros(1, 3)


def test_hidden_matter_costs_the_opacity_of_an_interval() -> None:
    loss = HiddenMatterLoss(BOX, 0.5, 100, length=0.1)(NOTHING, TARGET, guided(30.0))
    assert loss.item() == pytest.approx(0.5 * -math.expm1(-3.0), rel=1e-6)


def test_hidden_matter_is_pushed_out_unless_it_is_opaque() -> None:
    for density, expected in ((0.0, 0.1), (30.0, 0.1 * math.exp(-3.0)), (1e4, 0.0)):
        renderer = guided(density)
        HiddenMatterLoss(BOX, 1.0, length=0.1)(NOTHING, TARGET, renderer).backward()
        assert renderer.field.canonical.level.grad.item() == pytest.approx(expected, rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("batch", [1, 4])
def test_what_is_seen_in_canonical_space_costs_nothing_until_it_is_forgotten(batch: int) -> None:
    """Half of canonical space is seen once, through a deformation that shifts by a quarter of the box."""
    centers = torch.cartesian_prod(*[torch.arange(-0.75, 1.0, 0.5)] * 3)
    half = centers[centers[:, 0] > 0].repeat(batch, 1)
    renderer = guided(30.0, Shift())
    loss = HiddenMatterLoss(BOX, 1.0, 4000, length=0.1, resolution=4, memory_samples=4 * 32)
    opacity = -math.expm1(-3.0)
    # World x in [-1, 1] is canonical [-0.5, 1.5]; above 0 is three quarters, and what is beyond counts as at the face.
    for expected in [0.25] * (1 + 4 // batch) + [1.0]:
        picture = seen_at(half, torch.full((len(half),), 0.5 if loss.num_calls == 0 else 0.0))
        assert loss(picture, TARGET, renderer).item() == pytest.approx(expected * opacity, rel=0.1)


def test_a_share_too_small_to_see_does_not_count_as_seen() -> None:
    centers = torch.cartesian_prod(*[torch.arange(-0.75, 1.0, 0.5)] * 3)
    loss = HiddenMatterLoss(BOX, 1.0, resolution=4, length=0.1)
    value = loss(seen_at(centers, torch.full((64,), 1e-4)), TARGET, guided(30.0))
    assert value.item() == pytest.approx(-math.expm1(-3.0), rel=1e-6)
    assert loss(seen_at(centers, torch.full((64,), 1e-2)), TARGET, guided(30.0)) == 0


def test_no_gradient_of_hidden_matter_reaches_the_deformation() -> None:
    deformation = DisplacementDeformation(1, 8, ())
    torch.nn.init.normal_(deformation.mlp.output.weight)
    renderer = Renderer(DeformedField(deformation, GridField(BOX, [4, 8])), OccupancySampler(BOX, 0.02, 8))
    HiddenMatterLoss(BOX)(NOTHING, TARGET, renderer).backward()
    assert all(p.grad is None for p in deformation.parameters())
    assert renderer.field.canonical.table.grad.abs().sum() > 0


def test_hidden_matter_is_looked_for_in_occupied_cells_and_elsewhere_each_time() -> None:
    renderer = guided()
    mask = torch.zeros_like(renderer.sampler.occupied)
    mask[1, 2, 3, 4] = True
    renderer.sampler.occupy(mask)
    loss = HiddenMatterLoss(BOX)
    loss(NOTHING, TARGET, renderer)
    again = HiddenMatterLoss(BOX)
    again.load_state_dict(loss.state_dict())
    for each in (loss, again):
        each(NOTHING, TARGET, renderer)
    asked = renderer.field.canonical.asked
    lowest = torch.tensor([-0.5, -0.25, 0.0])
    for positions, times in asked:
        assert positions.shape == (1024, 3)
        assert ((positions >= lowest) & (positions <= lowest + 0.25)).all()
        assert ((times >= 0.5) & (times <= 1)).all()
    assert not torch.equal(asked[0][0], asked[1][0])
    assert torch.equal(asked[1][0], asked[2][0])


def test_hidden_matter_costs_nothing_where_nobody_knows_of_any() -> None:
    renderer = guided()
    assert HiddenMatterLoss(BOX)(NOTHING, TARGET, Renderer(renderer.field, StratifiedSampler(4))) == 0


@pytest.mark.parametrize(
    "setting", [{"weight": -1.0}, {"num_points": 0}, {"length": 0.0}, {"resolution": 0}, {"memory_samples": 0}]
)
def test_bad_settings_of_hidden_matter_are_named(setting: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(setting))):
        HiddenMatterLoss(BOX, **setting)


def test_hidden_matter_wants_a_deformed_field() -> None:
    with pytest.raises(ValueError, match="HiddenMatterLoss needs a deformed field, got FormulaField"):
        HiddenMatterLoss(BOX)(NOTHING, TARGET, RENDERER)


def test_rough_volumes_cost_once_they_have_joined() -> None:
    box = [[-1.0] * 3, [1.0] * 3]
    volumes = SpaceTimeVolumes(box, (4,), (1,), waits=True)
    field = DeformedField(IdentityDeformation(), GridField(box, (4,), 2, space_time=volumes))
    renderer, rgb = Renderer(field, StratifiedSampler(4)), torch.zeros(2, 3)
    assert SmoothVolumesLoss()(picture(rgb), rgb, renderer).item() == 0
    volumes.join()
    in_space, in_time = (float(x.detach()) for x in volumes.roughness())
    assert in_space > 0 == in_time  # two moments have no second difference
    loss = SmoothVolumesLoss(0.5, 7.0)(picture(rgb), rgb, renderer)
    assert loss.item() == pytest.approx(0.5 * in_space)
    assert torch.autograd.grad(loss, volumes.tables[0])[0].abs().sum() > 0
    assert SmoothVolumesLoss()(picture(rgb), rgb, RENDERER).item() == 0
    with pytest.raises(ValueError, match="time_weight must be >= 0"):
        SmoothVolumesLoss(time_weight=-1.0)


def of_knots(values: list[float]) -> tuple[Renderer, torch.nn.Parameter]:
    """A model whose deformation has learnt one feature of as many moments, and these."""
    deformation = DisplacementDeformation(1, 8, (), time_knots=len(values), knot_features=1)
    knots = deformation.encode_times.knots
    assert knots is not None
    with torch.no_grad():
        knots[:, 0] = torch.tensor(values)
    return Renderer(DeformedField(deformation, fog()), StratifiedSampler(4)), knots


def test_knots_of_which_pictures_say_nothing_are_between_their_neighbours_or_as_the_last() -> None:
    renderer, knots = of_knots([0.5, 0.0, 0.0, 2.0, 0.0, 0.0])
    rgb = torch.rand(2, 3)
    loss = SmoothKnotsLoss(3.0, rays_per_knot=None)
    assert loss(picture(rgb), rgb, renderer).item() == pytest.approx(3.0 * (0.25 + 4.0 + 4.0) / 5, rel=1e-6)
    optimizer = torch.optim.Adam([knots], lr=0.02)
    for _ in range(600):
        optimizer.zero_grad()
        loss(picture(rgb), rgb, renderer).backward()
        assert knots.grad is not None
        knots.grad[[0, 3]] = 0.0  # as those whose frames keep them where they are
        optimizer.step()
    expected = torch.tensor([0.5, 1.0, 1.5, 2.0, 2.0, 2.0])
    torch.testing.assert_close(knots.detach()[:, 0], expected, rtol=0, atol=0.02)


def test_the_longer_moments_are_looked_at_the_smoother_they_have_to_be() -> None:
    """In proportion to rays, from a number for each knot on: 6 knots of 5 rays each, 2 rays a call."""
    renderer, _ = of_knots([0.5, 0.0, 0.0, 2.0, 0.0, 0.0])
    rgb = torch.rand(2, 3)
    loss = SmoothKnotsLoss(2.0, rays_per_knot=5)
    found = [loss(picture(rgb), rgb, renderer).item() for _ in range(60)]
    expected = [2.0 * max(1, 2 * (call + 1) / 30) * 8.25 / 5 for call in range(60)]
    assert found == pytest.approx(expected, rel=1e-5)
    going_on = SmoothKnotsLoss(2.0, rays_per_knot=5)
    going_on.load_state_dict(loss.state_dict())
    assert going_on(picture(rgb), rgb, renderer).item() == pytest.approx(2.0 * 122 / 30 * 8.25 / 5, rel=1e-5)


def test_what_has_no_knots_is_not_rough() -> None:
    rgb = torch.rand(2, 3)
    assert SmoothKnotsLoss()(picture(rgb), rgb, RENDERER).item() == 0
    assert DisplacementDeformation(1, 8, ()).encode_times.roughness().item() == 0
    with pytest.raises(ValueError, match="weight must be >= 0"):
        SmoothKnotsLoss(-1.0)
    with pytest.raises(ValueError, match="rays_per_knot must be"):
        SmoothKnotsLoss(rays_per_knot=0)
