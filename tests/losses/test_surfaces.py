"""The eikonal term: zero for true distances, what it costs where they are not, and what bends cost."""

import pytest
import torch
from torch import Tensor

from dnerf.core.rays import Rays
from dnerf.deformations import Deformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, NeuSField, RadianceField
from dnerf.fields.normals import differences
from dnerf.losses import Batch, EikonalLoss, UnseenSpaceLoss
from dnerf.losses.regularizers import canonical_surface
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
NOTHING = Batch(torch.zeros(2, 4), torch.zeros(2, 3))


class Slope(NeuSField):
    """A plane whose distance grows too fast, by a factor."""

    factor = 1.0

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        return self.factor * (0.6 * positions[..., 0] + 0.8 * positions[..., 2]) + 0 * raw


class Stretch(Deformation):
    """Twice as large in canonical space."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return 2 * positions


def slope(factor: float) -> Slope:
    field = Slope(BOX, (4, 8), 2, max_rows=1024)
    field.factor = factor
    return field


def term(field: RadianceField, bending: float = 0.0, saturation: float = 1e9) -> Tensor:
    z = torch.tensor([-0.1, 0.2])
    rays = Rays(torch.tensor([[0.0, 0, 2], [0.1, 0, 2]]), torch.tensor([[0.0, 0, -1]] * 2), z.abs(), 0 * z, 4 + 0 * z)
    model = Renderer(field, StratifiedSampler(16))
    loss = EikonalLoss(BOX, bending=bending, saturation=saturation)
    loss.check(model)
    return loss(model(rays), NOTHING, model)


@pytest.mark.parametrize("factor", [1.0, 0.5, 3.0, 0.0])
def test_the_term_is_the_squared_deviation_of_the_slope_from_one(factor: float) -> None:
    field = slope(factor)
    value = term(field)
    assert float(value.detach()) == pytest.approx((factor - 1) ** 2, abs=1e-5)
    value.backward()
    assert field.table.grad.isfinite().all()


class Ball(Slope):
    """Of radius 0.5 about the origin."""

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        return positions.norm(dim=-1) - 0.5 + 0 * raw


def test_bends_of_a_ball_are_those_of_its_second_derivatives() -> None:
    """Along axis i the second derivative of |x| is (1 - n_i^2) / |x|."""
    x = 0.5 * torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=-1)
    _, found = differences(Ball(BOX, (4,), 2, max_rows=1024).double(), x, x[:, 0], 0.01)
    expected = ((1 - (x / 0.5) ** 2) / 0.5).square().sum(-1) * 0.01**2
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)
    assert (found <= 2 * (0.01 / 0.5) ** 2 * 1.001).all()


def test_bends_are_priced_at_the_samples_alone() -> None:
    """All rays are near a fold of the distance, which few places of the box are."""

    class Fold(Slope):
        def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
            return positions[..., 1].abs() + 0 * raw

    field = DeformedField(IdentityDeformation(), Fold(BOX, (4,), 2, max_rows=1024))
    free, dear, robust = (float(term(field, *price).detach()) for price in ((0.0,), (3.0,), (3.0, 0.5)))
    # At a distance y of the fold slopes change by 2 (1 - |y| / h) over a step h; samples lie at y = 0.
    assert dear - free == pytest.approx(3.0 * 4, rel=1e-3)
    assert robust - free == pytest.approx(3.0 * 4 / (1 + 4 / 0.5), rel=1e-3)


def test_it_holds_in_canonical_space() -> None:
    for deformation in (IdentityDeformation(), Stretch()):
        assert float(term(DeformedField(deformation, slope(1.0))).detach()) == pytest.approx(0, abs=1e-5)


def test_differences_are_the_gradient_up_to_second_order() -> None:
    torch.manual_seed(0)
    field = NeuSField(BOX, (2,), 2, max_rows=1024, hidden_features=16, num_layers=1).double()
    with torch.no_grad():
        field.table.mul_(30)
    x = (0.1 + 0.3 * torch.rand(50, 3, dtype=torch.float64)).requires_grad_()  # within one cell
    (exact,) = torch.autograd.grad(field.distance(x, x[:, 0]).sum(), x)
    # A ReLU bends in places: most are smooth.
    errors = [(differences(field, x, x[:, 0], h)[0] - exact).norm(dim=-1).detach().quantile(0.7) for h in (2e-3, 1e-3)]
    assert errors[0] < 1e-4
    assert errors[1] < 0.3 * errors[0]


def test_fields_without_a_surface_and_bad_settings_are_named() -> None:
    grid = DeformedField(IdentityDeformation(), GridField(BOX, (4,), 2, max_rows=1024))
    assert canonical_surface(grid) is None
    with pytest.raises(ValueError, match="EikonalLoss needs a field with a signed distance, got DeformedField"):
        EikonalLoss(BOX).check(Renderer(grid, StratifiedSampler(8)))
    for changes in ({"bending": -1.0}, {"saturation": 0.0}):
        with pytest.raises(ValueError, match=f"{next(iter(changes))} must be"):
            EikonalLoss(BOX, **changes)


def test_unseen_insides_of_surfaces_are_not_emptied() -> None:
    model = Renderer(DeformedField(IdentityDeformation(), slope(1.0)), StratifiedSampler(4))
    with pytest.raises(ValueError, match="needs a density field"):
        UnseenSpaceLoss(BOX).check(model)


def test_the_batch_s_own_samples_count() -> None:
    """Steep in a slab that all rays lie in, and a twentieth of the places of the box."""

    class Steep(Slope):
        def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
            x = positions[..., 1]
            return positions[..., 2] + torch.where(x.abs() < 0.05, 5 * x, 0) + 0 * raw

    field = DeformedField(IdentityDeformation(), Steep(BOX, (512,), 2, max_rows=1024))
    assert float(term(field).detach()) > 4.0  # half of (sqrt(26) - 1)^2 = 16.8, by the samples
