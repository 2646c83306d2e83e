"""Losses about motion against the closed forms of simple flows."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.closed_flows import Expansion, Rotation
from dnerf.core.compositing import FieldOutput, Rendering
from dnerf.deformations import Deformation, DisplacementDeformation, FlowDeformation
from dnerf.deformations.base import WrappedDeformation
from dnerf.deformations.inversion import folding
from dnerf.deformations.velocities import NetworkVelocity, Velocity
from dnerf.fields import DeformedField, GridField, RadianceField
from dnerf.losses import AppearanceConstancyLoss, Batch, ElasticLoss, JacobianDeterminantLoss, RestLoss
from dnerf.losses.deformation import spread_directions
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler
from dnerf.scenes import make_scene

LOSSES = {
    "elastic": ElasticLoss, "jacobian": JacobianDeterminantLoss,
    "appearance": AppearanceConstancyLoss, "rest": RestLoss,
}  # fmt: skip
BATCH = Batch(torch.zeros(8, 4), torch.zeros(8, 3))
every_loss = pytest.mark.parametrize("name", LOSSES)


def renderer_of(velocity: Velocity, **settings: object) -> Renderer:
    settings = {"canonical_time": 0.0, "num_steps": 16, **settings}
    return Renderer(DeformedField(FlowDeformation(velocity, **settings), make_scene("static")), StratifiedSampler(4))


def rendering(count: int = 64, dtype: torch.dtype = torch.float64) -> Rendering:
    positions, times = torch.rand(count, 3, dtype=dtype) - 0.5, torch.rand(count, dtype=dtype)
    extras = {"positions": positions, "times": times, "canonical_positions": positions}
    output = FieldOutput(torch.ones(count), torch.ones(count, 3), extras)
    return Rendering(torch.zeros(8, 3), torch.zeros(8), torch.zeros(8), weights=torch.rand(count), output=output)


class Linear(Deformation):
    """x -> A x, the same at all times."""

    def __init__(self, matrix: Tensor) -> None:
        super().__init__()
        self.matrix = torch.nn.Parameter(matrix)

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions @ self.matrix.to(positions.dtype).mT


def elastic(matrix: Tensor, count: int = 4000, **settings: float) -> Tensor:
    renderer = Renderer(DeformedField(Linear(matrix), make_scene("static")), StratifiedSampler(4))
    return ElasticLoss(1.0, count, **settings)(rendering(count), BATCH, renderer)


def determinant_price(matrix: Tensor, **settings: float) -> Tensor:
    renderer = Renderer(DeformedField(Linear(matrix), make_scene("static")), StratifiedSampler(4))
    return JacobianDeterminantLoss(1.0, **settings)(rendering(), BATCH, renderer)


def test_rigid_motion_is_not_elastic() -> None:
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    # The floor under the stretch, LEAST_STRETCH^2 = 1e-4 of its square, is all that is left: (1e-4 / 2)^2.
    assert elastic(rotation).item() <= 2.6e-9


def test_uneven_stretch_costs_the_mean_over_all_directions() -> None:
    """Against the mean over many random directions on the sphere."""
    matrix = torch.tensor([[1.5, 0.2, 0.0], [0.0, 0.6, 0.1], [0.0, 0.0, 1.0]], dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, dtype=torch.float64), dim=-1)
    expected = torch.log((directions @ matrix.mT).norm(dim=-1)).square().mean().item()
    assert elastic(matrix).item() == pytest.approx(expected, rel=0.05)  # shares of 4000 points are random


@given(logarithm=st.floats(-0.7, 1.2), saturation=st.sampled_from([1e-3, 0.04, 1.0]))
def test_saturated_prices_are_those_of_geman_and_mcclure(logarithm: float, saturation: float) -> None:
    """An even stretch, of logarithm x: the price is s x^2 / (s + x^2), below s."""
    square = logarithm**2
    found = elastic(math.exp(logarithm) * torch.eye(3, dtype=torch.float64), saturation=saturation).item()
    assert found == pytest.approx(saturation * square / (saturation + square), rel=0.02, abs=1e-4 * saturation)
    assert found <= saturation


def test_collapse_costs_much_and_is_pushed_open() -> None:
    deformation = Linear(torch.diag(torch.tensor([1.0, 1.0, 0.05], dtype=torch.float64)))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(4))
    loss = ElasticLoss(1.0)(rendering(), BATCH, renderer)
    loss.backward()
    assert loss.item() > 0.1
    assert deformation.matrix.grad[2, 2] < -0.1  # a step against the gradient makes it thicker


def test_gradient_is_finite_where_all_is_collapsed() -> None:
    deformation = Linear(torch.zeros(3, 3))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(4))
    ElasticLoss(1.0)(rendering(dtype=torch.float32), BATCH, renderer).backward()
    assert torch.isfinite(deformation.matrix.grad).all()


class Shift(Deformation):
    """x -> x + v t."""

    def __init__(self, velocity: tuple[float, float, float]) -> None:
        super().__init__()
        self.velocity = torch.nn.Parameter(torch.tensor(velocity, dtype=torch.float64))

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions + self.velocity * times[..., None]


def test_rest_costs_distances_at_the_times_of_half_a_batch_away_too() -> None:
    shown = replace(rendering(), weights=torch.ones(64))
    renderer = Renderer(DeformedField(Shift((0.3, 0.0, 0.4)), make_scene("static")), StratifiedSampler(4))
    times = shown.output.extras["times"]
    expected = 0.5 * sum(float(times[i if i % 2 == 0 else (i + 32) % 64]) for i in range(64)) / 64
    assert RestLoss(1.0)(shown, BATCH, renderer).item() == pytest.approx(expected)


def test_what_rests_has_no_gradient_and_costs_nothing() -> None:
    deformation = Shift((0.0, 0.0, 0.0))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(4))
    loss = RestLoss(1.0)(rendering(), BATCH, renderer)
    loss.backward()
    assert loss.item() == pytest.approx(0, abs=2e-4)
    assert deformation.velocity.grad.abs().max() == 0


def test_what_keeps_volumes_costs_nothing() -> None:
    turned = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    squeezed = torch.diag(torch.tensor([4.0, 0.5, 0.5], dtype=torch.float64))
    sheared = torch.eye(3, dtype=torch.float64)
    sheared[0, 2] = 1.7
    for matrix in (turned * turned.det().sign(), squeezed, sheared):
        assert determinant_price(matrix, limit=1.0).item() < 1e-20


NINE = st.lists(st.floats(-2, 2), min_size=9, max_size=9)


@given(NINE, st.sampled_from([0.5, 1.0]), st.sampled_from([0.01, 0.1, 0.5]))
def test_a_determinant_costs_what_lacks_to_the_limit_and_nothing_beyond(
    entries: list[float], limit: float, least: float
) -> None:
    matrix = torch.tensor(entries, dtype=torch.float64).reshape(3, 3)
    determinant = float(torch.linalg.det(matrix))
    logarithm = math.log(determinant) if determinant > least else math.log(least) + (determinant - least) / least
    expected = min(0.0, logarithm - math.log(limit)) ** 2
    assert determinant_price(matrix, limit=limit, least=least).item() == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("thickness", [0.4, 0.05, 0.0, -1.0])
def test_lost_volume_is_pulled_back(thickness: float) -> None:
    deformation = Linear(torch.diag(torch.tensor([1.0, 1.0, thickness])))
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(4))
    JacobianDeterminantLoss(1.0)(rendering(dtype=torch.float32), BATCH, renderer).backward()
    assert torch.isfinite(deformation.matrix.grad).all()
    assert deformation.matrix.grad[2, 2] < -1


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_folds_is_unfolded(seed: int) -> None:
    """A displacement too sharp folds space; minimising the loss alone leaves none that does, and some motion."""
    torch.manual_seed(seed)
    deformation = DisplacementDeformation(2, 32, (), position_frequencies=2, time_frequencies=2, canonical_time=None)
    torch.nn.init.normal_(deformation.mlp.output.weight, std=0.2)
    renderer = Renderer(DeformedField(deformation, make_scene("static")), StratifiedSampler(4))
    shown = rendering(500, torch.float32)
    shown.weights.fill_(1.0)
    places = [shown.output.extras[name] for name in ("positions", "times")]
    assert folding(deformation, *places).least_determinant < 0
    optimizer = torch.optim.Adam(deformation.parameters(), 3e-3)
    for _ in range(200):
        optimizer.zero_grad()
        JacobianDeterminantLoss(1.0, 500)(shown, BATCH, renderer).backward()
        optimizer.step()
    assert folding(deformation, *places).least_determinant > 0.1
    assert (deformation(*places) - places[0]).norm(dim=-1).mean() > 0.1


def test_directions_are_spread_evenly() -> None:
    directions = spread_directions(torch.zeros(1000, 3, dtype=torch.float64))
    assert (directions.norm(dim=-1) - 1).abs().max() < 1e-12
    assert (directions.mean(0)).abs().max() < 2e-3
    assert (directions.mT @ directions / 1000 - torch.eye(3) / 3).abs().max() < 2e-3
    assert spread_directions(torch.zeros(0, 3)).shape == (0, 3)


class Changing(RadianceField):
    """What has an opacity over a length of 0.1 of `opacity t` and a red of `red t`, from 0 at time 0."""

    def __init__(self, opacity: float, red: float) -> None:
        super().__init__()
        self.strength = torch.nn.Parameter(torch.tensor([opacity, red], dtype=torch.float64))

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return -torch.log1p(-self.strength[0] * times) / 0.1

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        red = (self.strength[1] * times)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        return FieldOutput(self.density(positions, times), red)


def constancy(canonical: RadianceField, count: int = 5000, color: float = 1.0) -> Tensor:
    renderer = Renderer(DeformedField(Linear(torch.eye(3)), canonical), StratifiedSampler(4))
    return AppearanceConstancyLoss(1.0, count, length=0.1, color=color)(rendering(count), BATCH, renderer)


@pytest.mark.parametrize("options", [{"temporal_terms": 3}, {"temporal_terms": 3, "view_degree": 1}])
def test_change_has_a_price_and_constant_appearance_none(options: dict) -> None:
    grid = GridField([[-1.0] * 3, [1.0] * 3], (4,), 2, density_shift=3.0, **options).double()
    assert constancy(grid).item() < 1e-20
    torch.nn.init.normal_(grid.head.output.weight)
    torch.nn.init.normal_(grid.head.output.bias)
    loss = constancy(grid)
    loss.backward()
    assert loss.item() > 1e-3
    assert grid.table.grad.abs().max() > 0


def test_change_costs_the_mean_square_between_two_random_times() -> None:
    """E (t - t')^2 = 1 / 6 for two even times, so the gradient by a strength s is s / 3. Points' shares are random."""
    canonical = Changing(0.6, 0.9)
    loss = constancy(canonical)
    assert loss.item() == pytest.approx((0.6**2 + 0.9**2) / 6, rel=0.05)
    loss.backward()
    torch.testing.assert_close(canonical.strength.grad, canonical.strength.detach() / 3, rtol=0.05, atol=0)


@pytest.mark.parametrize("color", [0.0, 0.25])
def test_colours_may_change_at_another_price_than_opacity(color: float) -> None:
    loss = constancy(Changing(0.6, 0.9), color=color)
    assert loss.item() == pytest.approx((0.6**2 + color * 0.9**2) / 6, rel=0.05)
    with pytest.raises(ValueError, match="color must be >= 0"):
        AppearanceConstancyLoss(color=-0.1)


def test_the_price_of_change_does_not_move_anything() -> None:
    deformation = Linear(torch.eye(3, dtype=torch.float64))
    shown, renderer = rendering(), Renderer(DeformedField(deformation, Changing(0.6, 0.9)), StratifiedSampler(4))
    shown.output.extras["canonical_positions"] = deformation(shown.output.extras["positions"], torch.zeros(64))
    AppearanceConstancyLoss(1.0)(shown, BATCH, renderer).backward()
    assert deformation.matrix.grad is None
    shown.weights.zero_()
    assert AppearanceConstancyLoss(1.0)(shown, BATCH, renderer) == 0


@pytest.mark.parametrize("name", ["elastic", "jacobian"])
def test_gradients_reach_the_velocity(name: str) -> None:
    velocity = NetworkVelocity(((-1.0,) * 3, (1.0,) * 3), 2, 16)
    torch.nn.init.normal_(velocity.mlp.output.weight)
    renderer = renderer_of(velocity, solver="midpoint", num_steps=2)
    LOSSES[name]()(rendering(dtype=torch.float32), BATCH, renderer).backward()
    for parameter in velocity.parameters():
        assert torch.isfinite(parameter.grad).all()
    assert torch.count_nonzero(velocity.mlp.hidden[0].weight.grad) > 0


class Rough(WrappedDeformation):
    """Another deformation, and far from it."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.deformation(positions, times) + 0.3 * positions.square()


@every_loss
def test_wrapped_deformations_are_judged_by_what_they_wrap(name: str) -> None:
    renderer = renderer_of(Expansion(0.5), solver="euler", num_steps=4)
    shown, loss = rendering(), LOSSES[name]()
    expected = loss(shown, BATCH, renderer)
    renderer.field.deformation = Rough(renderer.field.deformation)
    assert loss(shown, BATCH, renderer) == expected


@every_loss
def test_points_are_spread_over_the_batch_and_bounded(name: str) -> None:
    points = LOSSES[name](1.0, 10)._points(rendering(64))
    assert len(points.times) == 10
    assert points.shares.sum().item() == pytest.approx(1)


@pytest.mark.parametrize(("num_rays", "num_samples"), [(1024, 64), (2048, 64), (1024, 192), (1000, 64), (512, 16)])
def test_points_of_dense_rays_are_of_all_distances(num_rays: int, num_samples: int) -> None:
    """Whatever divides what: equal steps over (R, S) samples might meet each ray at its first one only."""
    shape = (num_rays, num_samples)
    positions = torch.arange(num_samples).expand(shape)[..., None].expand(*shape, 3).double()
    extras = {"positions": positions, "times": torch.zeros(shape), "canonical_positions": positions}
    output = FieldOutput(torch.ones(shape), torch.ones(*shape, 3), extras)
    nothing = torch.zeros(num_rays)
    shown = Rendering(torch.zeros(num_rays, 3), nothing, nothing, weights=torch.ones(shape), output=output)
    points = ElasticLoss(1.0, 1024)._points(shown)
    assert 512 < len(points.times) <= 1024
    counts = points.positions[:, 0].long().bincount(minlength=num_samples).double()
    assert counts.min() > 0.3 * counts.mean()
    assert counts.max() < 2 * counts.mean()


@every_loss
def test_an_empty_image_costs_nothing(name: str) -> None:
    shown = rendering()
    shown.weights.zero_()
    loss = LOSSES[name]()(shown, BATCH, renderer_of(Rotation()))
    assert loss == 0


@every_loss
def test_a_field_without_deformation_is_named_before_training(name: str) -> None:
    LOSSES[name]().check(renderer_of(Rotation()))
    with pytest.raises(ValueError, match=f"{LOSSES[name].__name__} needs a deformed field, got "):
        LOSSES[name]().check(Renderer(make_scene("static"), StratifiedSampler(4)))


@pytest.mark.parametrize(("make", "message"), [
    (lambda: ElasticLoss(distance=0.0), "distance must be > 0"),
    (lambda: JacobianDeterminantLoss(least=-1.0), "least must be > 0"),
    (lambda: ElasticLoss(saturation=-0.1), "saturation must be > 0"),
    (lambda: JacobianDeterminantLoss(distance=-0.1), "distance must be > 0"),
    (lambda: JacobianDeterminantLoss(limit=1.5), r"limit must be in \[least, 1\] = \[0.1, 1\], got 1.5"),
    (lambda: JacobianDeterminantLoss(limit=0.05), r"limit must be in \[least, 1\] = \[0.1, 1\], got 0.05"),
    (lambda: AppearanceConstancyLoss(length=0.0), "length must be > 0"),
    (lambda: ElasticLoss(-1.0), "weight must be >= 0"), (lambda: ElasticLoss(1.0, 0), "num_points must be > 0"),
    (lambda: ElasticLoss(every=0), "every must be > 0"),
    (lambda: ElasticLoss(every=1.5), "every must be a whole number, got 1.5"),
])  # fmt: skip
def test_bad_settings_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
