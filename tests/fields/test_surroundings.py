"""What lies beyond the box, against closed forms."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput
from dnerf.core.rays import Rays
from dnerf.fields import RadianceField, SurroundingsBackground
from dnerf.rendering import Renderer
from dnerf.samplers import StratifiedSampler

BOX = [[-1.0] * 3, [1.0] * 3]


class Shells(RadianceField):
    """Even density up to a distance in contracted space, in red; beyond, nothing but blue light from infinity."""

    def __init__(self, density: float, until: float = 2.0) -> None:
        super().__init__()
        self.strength, self.until = torch.nn.Parameter(torch.tensor(density, dtype=torch.float64)), until

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return self.strength * (positions.abs().amax(-1) < self.until)

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        density = self.density(positions, times)
        is_dense = (density > 0)[..., None]
        return FieldOutput(density, torch.where(is_dense, density.new_tensor([1, 0, 0]), density.new_tensor([0, 0, 1])))


def rays(origins: list[list[float]], directions: list[list[float]]) -> Rays:
    count = len(origins)
    first, second = (torch.tensor(x, dtype=torch.float64) for x in (origins, directions))
    zero = torch.zeros(count, dtype=torch.float64)
    return Rays(first, torch.nn.functional.normalize(second, dim=-1), zero, zero, zero + 3)


OUTWARDS = rays([[0, 0, 0], [0, 0, 0.9], [0, 0, 3.0]], [[0, 1, 0], [0, 0, 1], [0, 0, -1]])


def surroundings(density: float, until: float = 2.0, num_intervals: int = 24) -> SurroundingsBackground:
    return SurroundingsBackground(BOX, Shells(density, until), num_intervals).double()


@pytest.mark.parametrize("density", [0.3, 2.0])
def test_even_density_up_to_a_distance_lets_through_what_its_integral_says(density: float) -> None:
    # Along an axis at distance r in half boxes: the integral of density / r^2 from 1 to 4, contracted to 2 - 1/4.
    through = math.exp(-density * (1 - 1 / 4))
    errors = []
    for num_intervals in (64, 256):
        color = surroundings(density, 2 - 1 / 4, num_intervals).eval()(OUTWARDS)
        expected = torch.tensor([1 - through, 0, through]).double().expand(3, 3)
        errors.append(float((color.detach() - expected).abs().max()))
    assert errors[0] < 0.02 * density
    assert errors[1] < 0.3 * errors[0]  # the shell's end lies within an interval


def test_distances_are_in_half_sides_of_an_oblong_box_and_densities_per_half_of_its_longest() -> None:
    half = torch.tensor([0.5, 2.0, 1.0], dtype=torch.float64)
    center = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    box = torch.stack([center - half, center + half]).tolist()
    model = SurroundingsBackground(box, Shells(0.8, 2 - 1 / 4), 512).double().eval()
    along = rays([center.tolist()] * 3, torch.eye(3).tolist())
    # From a face at h to 4 h: the integral of density / (2 (x / h)^2), 2 is half of the longest side.
    through = torch.exp(-0.8 * half / 2 * (1 - 1 / 4))
    torch.testing.assert_close(model(along)[:, 2].detach(), through, rtol=0, atol=2e-3)


class Waves(RadianceField):
    """Density and colour that change smoothly everywhere."""

    def density(self, positions: Tensor, times: Tensor) -> Tensor:
        return 1.5 + torch.sin(positions).sum(-1) / 3

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(self.density(positions, times), torch.sigmoid(positions + directions))


def test_gradcheck_to_rays_and_to_the_field() -> None:
    box = [[-0.5, -2.0, -1.0], [0.5, 1.0, 1.5]]
    through = rays([[0.1, 0.2, -0.3], [0.3, -0.5, 4.0]], [[0.3, 1, 0.2], [0.1, 0.2, -1]])
    model = SurroundingsBackground(box, Waves(), 6).double().eval()

    def shown(origins: Tensor, directions: Tensor) -> Tensor:
        return model(Rays(origins, directions, through.times, through.near, through.far))

    leaves = through.origins.clone().requires_grad_(), through.directions.clone().requires_grad_()
    assert torch.autograd.gradcheck(shown, leaves)
    shells = surroundings(0.7, num_intervals=6).eval()
    assert torch.autograd.gradcheck(lambda _: shells(through), (shells.field.strength,))


def test_nothing_gets_through_to_behind_infinity() -> None:
    color = surroundings(0.0).eval()(OUTWARDS)
    torch.testing.assert_close(color, torch.tensor([0.0, 0, 1]).double().expand(3, 3))
    assert surroundings(0.0).constant() is None


def test_rays_that_miss_the_box_begin_at_their_near_plane() -> None:
    beside = rays([[3, 0, -3], [3, 0, 3]], [[0, 0, 1], [0, 0, 1]])
    color = surroundings(50.0, 2 - 1 / 3.5).eval()(beside)  # up to 3.5 from the middle
    torch.testing.assert_close(color[0], torch.tensor([1.0, 0, 0]).double(), rtol=0, atol=1e-3)
    # It leaves soon: the integral of density / r^2 from 3 to 3.5.
    assert float(color[1, 2].detach()) == pytest.approx(math.exp(-50 * (1 / 3 - 1 / 3.5)), rel=0.02)


def test_training_draws_other_intervals_and_gradients_reach_the_field() -> None:
    model = surroundings(1.0, 1.6)
    colors = [model(OUTWARDS, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)]
    assert not torch.equal(*colors)
    colors[0][:, 0].sum().backward()
    assert model.field.strength.grad > 0  # type: ignore[operator]


def test_images_see_them_through_what_is_inside_and_opaque_rays_leave_them_out() -> None:
    inside = Shells(2.0, 0.5)
    renderer = Renderer(inside, StratifiedSampler(64), surroundings(0.0)).double().eval()
    through = rays([[0, 0, 3], [0, 0.9, 3]], [[0, 0, -1], [0, 0, -1]])
    through = Rays(through.origins, through.directions, through.times, through.near, through.far + 3)
    rendering = renderer(through)
    torch.testing.assert_close(rendering.rgb[:, 2], 1 - rendering.opacity)
    inside.strength.data.fill_(1e3)
    assert renderer(through).background[0].tolist() == [0, 0, 0]  # type: ignore[index]
    assert renderer(through).background[1].tolist() == [0, 0, 1]  # type: ignore[index]


def test_one_interval_is_refused() -> None:
    with pytest.raises(ValueError, match="num_intervals must be at least 2, got 1"):
        surroundings(1.0, num_intervals=1)
