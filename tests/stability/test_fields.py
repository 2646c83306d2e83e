"""Encodings, deformations and fields: float32 against the same in float64, bfloat16 autocast against float32."""

import copy
from functools import partial

import pytest
import torch
from cases import relative, value_and_gradients
from torch import Tensor, nn

from dnerf.core.geometry import move_by_twists, so3_exp
from dnerf.core.spherical_harmonics import spherical_harmonics
from dnerf.deformations import DisplacementDeformation
from dnerf.fields import DeformedField, GridField, NeRFField, PlaneFeatures
from dnerf.fields.activations import activate_density
from dnerf.kernels import GridLevels, grid_encode, use_backend
from dnerf.nn.encodings import SinusoidalEncoding

BOX = [[-1.5] * 3, [1.5] * 3]
FIELDS = {
    "nerf": lambda: NeRFField(4, 64, (2,), view_dependent=True),
    "grid": lambda: GridField(BOX, (8, 16, 64), 8, max_rows=4096, view_degree=3, temporal_terms=4),
    "grid, changing": lambda: GridField(BOX, (8, 16, 64), 8, max_rows=4096, temporal_terms=4),
    "grid, space-time": lambda: GridField(BOX, (8, 16, 64), 8, max_rows=4096, space_time=PlaneFeatures(BOX, (24, 48))),
    "deformed": lambda: DeformedField(moving(), GridField(BOX, (8, 16), 8)),
}


def moving() -> DisplacementDeformation:
    """A displacement that is not the identity that it starts as."""
    deformation = DisplacementDeformation(3, 32, (), canonical_time=None)
    nn.init.normal_(deformation.mlp.output.weight, std=0.1)
    return deformation


def points(count: int = 2000, size: float = 1.4) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    positions = size * (2 * torch.rand(count, 3, generator=generator) - 1)
    directions = nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    times = torch.rand(count, generator=generator)
    times[:2] = torch.tensor([0.0, 1.0])
    return positions, directions, times


def test_sinusoids_are_exact_at_every_octave() -> None:
    encoding = SinusoidalEncoding(3, 12)
    x = points(20000)[0]
    rounded, (gradient,) = value_and_gradients(encoding, x)
    exact, (truth,) = value_and_gradients(encoding, x.double())
    assert (rounded.double() - exact).abs().max() < 1e-6 / 8  # doubling is exact: one rounding of the sine is left
    assert ((gradient.double() - truth).abs() / 2**11).max() < 1e-6  # slopes up to 2^11, summed over the octaves


def test_encodings_stay_float32_under_autocast() -> None:
    x, d, _ = points(100)
    for encoding, values in ((SinusoidalEncoding(3, 12), x), (partial(spherical_harmonics, degree=4), d)):
        with torch.autocast("cpu", torch.bfloat16):
            inside = encoding(values)
        assert torch.equal(inside, encoding(values))


def test_spherical_harmonics_are_exact_along_axes_too() -> None:
    directions = torch.cat([points(20000)[1], torch.eye(3), -torch.eye(3)])
    harmonics = partial(spherical_harmonics, degree=4)
    rounded, (gradient,) = value_and_gradients(harmonics, directions)
    exact, (truth,) = value_and_gradients(harmonics, directions.double())
    assert (rounded.double() - exact).abs().max() < 4e-6  # numbers of up to 3, in sums of terms up to 10
    assert (gradient.double() - truth).abs().max() < 1e-4  # sums of 25 slopes up to 30


def test_grid_lookups_are_exact_on_and_off_the_box() -> None:
    levels = GridLevels((16, 128, 512), 1 << 14)
    positions = torch.cat([1.5 * torch.rand(8000, 3) - 0.25, torch.tensor([[0.0, 1.0, 0.5], [1e30, -1e30, 0.0]])])
    table = torch.randn(levels.num_rows, 8)

    def encode(p: Tensor, t: Tensor) -> Tensor:
        return grid_encode(p, t, levels)

    rounded, gradients = value_and_gradients(encode, positions, table)
    with use_backend("reference"):
        exact, truths = value_and_gradients(encode, positions.double(), table.double())
    # A position is known to 6e-8, which is 512 * 6e-8 = 3e-5 of a cell; values differ by up to 8 between vertices.
    assert (rounded.double() - exact).abs().max() < 3e-4
    assert (rounded.double() - exact).abs().mean() < 3e-6
    assert all(torch.isfinite(g).all() for g in gradients)
    assert relative(gradients[1], truths[1], floor=1.0).max() < 1e-3
    assert (gradients[0][-1, :2] == 0).all()


@pytest.mark.parametrize("name", FIELDS)
def test_fields_in_float32_agree_with_float64(name: str) -> None:
    field = FIELDS[name]()
    truth = copy.deepcopy(field).double()
    positions, directions, times = points()

    def density(network: nn.Module, x: Tensor, t: Tensor) -> Tensor:
        return network.density(x, t).log()

    rounded, gradients = value_and_gradients(lambda x: density(field, x, times), positions)
    with use_backend("reference"):
        exact, truths = value_and_gradients(lambda x: density(truth, x, times.double()), positions.double())
        exact_rgb = truth(*(x.double() for x in (positions, directions, times))).rgb
    # Octave 9 magnifies the rounding of a position, 6e-8 x 1.4, by 2^9: 4e-5 in the encoding; networks add some.
    assert (rounded.double() - exact).abs().max() < 1e-3
    assert (rounded.double() - exact).abs().mean() < 1e-5
    # Slopes jump where a ReLU switches or a cell ends: nearly all agree, none is wild.
    scale = truths[0].abs().mean()
    assert ((gradients[0].double() - truths[0]).abs() / scale).quantile(0.98) < 1e-2
    assert torch.isfinite(gradients[0]).all()
    rgb = field(positions, directions, times).rgb
    assert (rgb.double() - exact_rgb).abs().max() < 1e-3


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("size", [1e3, 1e6])
def test_fields_far_outside_their_box_stay_finite(name: str, size: float) -> None:
    field = FIELDS[name]()
    positions, directions, times = points(500, size)
    x = positions.requires_grad_()
    output = field(x, directions, times)
    (output.density.clamp(max=1e4).sum() + output.rgb.sum()).backward()
    assert torch.isfinite(output.density).all()
    assert torch.isfinite(output.rgb).all()
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_densities_are_finite_for_every_float32(activation: str) -> None:
    magnitudes = 10 ** torch.linspace(-38, 38.5, 20000)
    raw = torch.cat([-magnitudes, torch.zeros(1), magnitudes])
    value, (gradient,) = value_and_gradients(lambda x: activate_density(x, activation, -1.0), raw)
    finite = torch.isfinite(value) | (raw > 3e38)
    assert finite.all()
    assert torch.isfinite(gradient).all()
    exact = activate_density(raw.double(), activation, -1.0)
    moderate = (raw.abs() < 30) & (exact > 1e-30)
    # exp(x - 1): the sum is rounded to 6e-8 x 30.
    assert relative(value, exact)[moderate].max() < 5e-6


@pytest.mark.parametrize("name", FIELDS)
def test_networks_pass_on_a_nan_rather_than_hide_it(name: str) -> None:
    field = FIELDS[name]()
    positions, directions, times = points(4)
    positions[1] = torch.nan
    assert torch.isnan(field(positions, directions, times).density).tolist() == [False, True, False, False]


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-12, 1e-6, 1e-3, 1.0, 3.14159, 6.28318, 100.0])
def test_rotations_and_screws_are_exact_at_every_angle(size: float) -> None:
    generator = torch.Generator().manual_seed(1)
    vectors = size * nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=-1)
    twists = torch.cat([vectors, torch.randn(2000, 3, generator=generator)], dim=-1)
    place = torch.tensor([0.25, -0.5, 0.125])  # exact in either precision
    moved = lambda twists: move_by_twists(twists, place.to(twists.dtype).expand(len(twists), 3))  # noqa: E731
    for function, inputs in ((so3_exp, vectors), (moved, twists)):
        rounded, (gradient,) = value_and_gradients(function, inputs)
        exact, (truth,) = value_and_gradients(function, inputs.double())
        # Angles of 100 radians are known to 4e-6.
        assert (rounded.double() - exact).abs().max() < 1e-6 * max(1.0, 10 * size)
        assert (gradient.double() - truth).abs().max() < 1e-5 * max(1.0, 10 * size)


def test_displacement_is_the_identity_at_its_canonical_time_in_every_precision() -> None:
    deformation = DisplacementDeformation(3, 32, (), canonical_time=0.0)
    nn.init.normal_(deformation.mlp.output.weight)
    positions, _, times = points(300)
    assert torch.equal(deformation(positions, 0 * times), positions)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(deformation(positions, 0 * times), positions)
    moved = deformation(positions, times)
    exact = copy.deepcopy(deformation).double()(positions.double(), times.double())
    assert (moved.double() - exact).abs().max() < 1e-3
