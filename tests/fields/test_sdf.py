"""Signed distances: NeuS's and VolSDF's opacity against closed forms, and what fields that know intervals must do."""

import math

import pytest
import torch
from torch import Tensor

from dnerf.core.compositing import FieldOutput, composite
from dnerf.core.quadrature import interval_depths
from dnerf.core.rays import Rays, Samples
from dnerf.deformations import Deformation, DisplacementDeformation, IdentityDeformation
from dnerf.fields import DeformedField, GridField, NeuSField, SDFField, VolSDFField
from dnerf.fields.base import PAD_TO, ends_of, evaluate_samples, interval_aware, surface_of
from dnerf.rendering.renderer import Renderer
from dnerf.samplers import StratifiedSampler

BOX = [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
KINDS = (NeuSField, VolSDFField)
every_kind = pytest.mark.parametrize("kind", KINDS)


def small(kind: type[SDFField], width: float = 0.1, **options: float) -> SDFField:
    torch.manual_seed(0)
    field = kind(BOX, (4, 9), 2, max_rows=1024, hidden_features=16, num_layers=1, width=width, **options)
    return field.double()


def moved(field: SDFField) -> DeformedField:
    torch.manual_seed(1)
    deformation = DisplacementDeformation(2, 16, (), position_frequencies=2, time_frequencies=2)
    with torch.no_grad():
        for parameter in deformation.parameters():
            parameter += 0.05 * torch.randn(parameter.shape)
    return DeformedField(deformation, field).double()


class Plane(NeuSField):
    """The plane z = 0, with inside below."""

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        return positions[..., 2] + 0 * raw


class VolPlane(VolSDFField):
    """The same with VolSDF's density."""

    def _distance(self, positions: Tensor, raw: Tensor) -> Tensor:
        return positions[..., 2] + 0 * raw


def crossing(cosine: float, num_samples: int, reach: float = 3.0) -> tuple[Rays, Samples]:
    """A ray that crosses the plane at distance `reach`, at an angle with that cosine to its normal."""
    direction = torch.tensor([[math.sqrt(1 - cosine**2), 0.0, -cosine]], dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    rays = Rays(-reach * direction, direction, 0.3 * one, 0 * one, 2 * reach * one)
    return rays, StratifiedSampler(num_samples).eval()(rays, small(NeuSField))


def mean_distance(field: SDFField, cosine: float, num_samples: int = 4096) -> float:
    """How far behind the plane the light of a ray is absorbed on average."""
    rays, samples = crossing(cosine, num_samples)
    with torch.no_grad():
        rendering = composite(samples, evaluate_samples(field, samples, rays)[0])
    assert rendering.opacity > 1 - 1e-9
    return float(rendering.depth) - 3.0


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.2])
def test_neus_lets_half_of_the_light_through_to_the_surface(cosine: float) -> None:
    """Its transmittance is Phi(s d), so the median of the light lies where the distance is zero, at any angle."""
    field = Plane(BOX, (4,), 2, max_rows=1024, width=0.02).double()
    rays, samples = crossing(cosine, 600)  # an even number: an edge lies on the plane
    with torch.no_grad():
        weights = composite(samples, evaluate_samples(field, samples, rays)[0]).weights
    expected = torch.sigmoid(field.sharpness * cosine * (3 - samples.ends)) - 1
    torch.testing.assert_close(-weights.cumsum(-1), expected, rtol=1e-9, atol=1e-12)
    assert float(weights[0, :300].sum()) == pytest.approx(0.5, abs=1e-12)
    assert abs(mean_distance(field, cosine)) < 1e-6  # the weights are even about the hit


@pytest.mark.parametrize("cosine", [1.0, 0.5, 0.2])
def test_volsdf_is_biased_by_what_its_closed_form_says(cosine: float) -> None:
    """With depth t behind the plane in units of the width b along the normal, and k = 1 / cosine: transmittance is
    exp(-k e^u / 2) in front (u = c t / b < 0) and exp(-k (1/2 + u - (1 - e^-u) / 2)) behind. The mean of t is the
    integral of transmittance behind minus that of what is lost in front, here by a fine trapezium rule."""
    field = VolPlane(BOX, (4,), 2, max_rows=1024, width=0.02).double()
    width, k = 1 / float(field.sharpness.detach()), 1 / cosine
    u = torch.linspace(0, 60, 600_001, dtype=torch.float64)
    behind = torch.exp(-k * (0.5 + u - 0.5 * (1 - torch.exp(-u))))
    lost = -torch.expm1(-0.5 * k * torch.exp(-u))
    expected = float(torch.trapezoid(behind - lost, u)) * width / cosine
    found = mean_distance(field, cosine, 20_000)
    assert found == pytest.approx(expected, abs=2e-3 * width)
    assert abs(found) > 0.02 * width


def test_neus_is_its_published_opacity() -> None:
    field = moved(small(NeuSField, 0.02))
    positions = torch.rand(2, 300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    starts, ends, times = positions[0], positions[0] + 0.1 * (positions[1] - positions[0]), positions[1, :, 0].abs()
    with torch.no_grad():
        depth = field.between(starts, ends, ends, times).density * (ends - starts).norm(dim=-1)
        first, last = (torch.sigmoid(field.canonical.sharpness * field.distance(x, times)) for x in (starts, ends))
    torch.testing.assert_close(-torch.expm1(-depth), ((first - last) / first).clamp(min=0), rtol=1e-7, atol=1e-12)


def test_neus_far_inside_and_outside_is_finite_in_value_and_gradient() -> None:
    field = small(NeuSField, 1e-4, least_width=1e-6).float()
    z = torch.tensor([0.0, 0.0, 0.8, -0.8, 1e4, 1e15, 0.3])
    starts = torch.stack([0 * z, 0 * z, z], dim=-1).requires_grad_()
    ends = starts - torch.tensor([0.0, 1e-7, 1e-3, 1e-3, 1.0, 1.0, 10.0])[:, None] * torch.tensor([0.0, 0.0, 1.0])
    output = field.between(starts, ends, ends, torch.zeros(7))
    assert output.density.isfinite().all()
    assert (output.density >= 0).all()
    assert float(output.density[0].detach()) == pytest.approx(float(field.sharpness.detach()), rel=1e-5)
    output.density.sum().backward()
    assert starts.grad.isfinite().all()
    assert all(p.grad.isfinite().all() for p in field.parameters())


@every_kind
def test_density_far_away_and_at_the_surface_is_finite_in_value_and_gradient(kind: type[SDFField]) -> None:
    field = small(kind, 1e-4)
    distance = torch.tensor([-1e30, -1.0, 0.0, 1.0, 1e30], dtype=torch.float64, requires_grad=True)
    density = field.density_of(distance)
    sharpness = float(field.sharpness.detach())
    torch.testing.assert_close(density.detach(), torch.tensor([1.0, 1, 0.5, 0, 0], dtype=torch.float64) * sharpness)
    density.sum().backward()
    slope = {NeuSField: 0.25, VolSDFField: 0.5}[kind] * sharpness**2
    assert float(distance.grad[2]) == pytest.approx(-slope)
    assert distance.grad.isfinite().all()
    positions = torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    ball = positions.norm(dim=-1) - 0.8  # with which training begins, and what a fresh head makes of features of 1e-2
    torch.testing.assert_close(field.distance(positions, positions[:, 0].abs()), ball, rtol=0, atol=0.05)
    assert field.log_width.grad.isfinite()


def test_gradcheck_of_intervals() -> None:
    field = small(NeuSField)
    generator = torch.Generator().manual_seed(2)
    starts, ends = (torch.rand(4, 3, dtype=torch.float64, generator=generator).requires_grad_() for _ in range(2))
    parameters = (field.table, field.log_width)

    def outputs(starts: Tensor, ends: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        output = field.between(starts, ends, ends, torch.zeros(4))
        return output.density, output.rgb

    for model in (field, moved(field)):
        assert torch.autograd.gradcheck(outputs, (starts, ends, *parameters), eps=1e-7, atol=1e-5), model


def test_ends_that_intervals_share_are_evaluated_once() -> None:
    rays, samples = crossing(0.5, 8)
    packed = samples.packed(torch.tensor([[True, True, False, True, True, True, False, True]]))
    starts, ends = (rays.places(packed.ray_indices, x)[0] for x in (packed.starts, packed.ends))
    directions, times = rays.directions.expand(6, 3), torch.zeros(6, dtype=torch.float64)
    shared = ends_of(starts, ends, directions, times)
    num_ends = 6 + 3  # one more than intervals for each of three runs
    assert len(shared.positions) == PAD_TO
    assert torch.equal(shared.positions[num_ends:], ends[-1:].expand(PAD_TO - num_ends, 3))
    assert not torch.equal(shared.positions[num_ends - 2], ends[-1])
    first, last = shared.pairs(shared.positions)
    assert torch.equal(first, starts)
    assert torch.equal(last, ends)
    of_none = ends_of(starts[:0], ends[:0], directions[:0], times[:0])
    assert [len(x) for x in of_none.pairs(of_none.positions)] == [0, 0]


class Stretched(Deformation):
    """Space three times as long along z."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return positions * torch.tensor([1.0, 1.0, 3.0], dtype=positions.dtype)


def test_mean_density_under_a_deformation_refers_to_lengths_in_the_world() -> None:
    field = DeformedField(Stretched(), Plane(BOX, (4,), 2, max_rows=1024, width=0.02).double())
    rays, samples = crossing(1.0, 64)
    with torch.no_grad():
        output, positions, _ = evaluate_samples(field, samples, rays)
        depth = interval_depths(output.density, samples.lengths)
    z = field.canonical.sharpness * 3 * (3 - torch.cat([samples.starts, samples.ends[:, -1:]], dim=-1))
    softplus = torch.nn.functional.softplus(-z, threshold=700)
    torch.testing.assert_close(depth, softplus[:, 1:] - softplus[:, :-1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(output.extras["positions"], positions)
    torch.testing.assert_close(output.extras["canonical_positions"], Stretched()(positions, positions[..., 0]))


class Grey(NeuSField):
    """Another `forward`, of which `between` knows nothing."""

    def forward(self, positions: Tensor, directions: Tensor, times: Tensor) -> FieldOutput:
        return FieldOutput(super().forward(positions, directions, times).density, torch.full_like(positions, 0.5))


def test_only_fields_that_know_intervals_are_asked_for_them() -> None:
    grid = GridField(BOX, (4,), 2, max_rows=1024)
    assert interval_aware(grid) is None
    assert interval_aware(DeformedField(IdentityDeformation(), grid)) is None
    assert interval_aware(moved(small(VolSDFField))) is None
    assert interval_aware(Grey(BOX, (4,), 2, max_rows=1024)) is None
    assert interval_aware(moved(small(NeuSField))) is not None
    assert surface_of(DeformedField(IdentityDeformation(), grid)) is None


def test_detail_follows_the_levels_that_are_open() -> None:
    field = NeuSField([[-1.0, -1, -1], [1, 3, 1]], (4, 8, 16), 2, window_end=0.5)
    for progress, cell in ((0.0, 1.0), (0.25, 0.5), (0.5, 0.25), (1.0, 0.25)):
        field.set_progress(progress)
        assert float(field.detail) == cell


def test_distances_keep_their_precision_under_autocast() -> None:
    field = small(NeuSField).float().requires_grad_(False)
    with torch.no_grad():
        field.head.output.bias[0] = 0.75  # between 0.5 and 1 bfloat16 tells apart 0.004
    positions = torch.rand(64, 3)
    exact = field.distance(positions, torch.zeros(64))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = field.distance(positions, torch.zeros(64))
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded, exact, rtol=0, atol=5e-4)  # hidden features are small, and rounded


def test_rules_that_read_densities_at_points_are_refused() -> None:
    with pytest.raises(ValueError, match="quadrature must be constant"):
        Renderer(moved(small(NeuSField)), StratifiedSampler(4), quadrature="linear")
    Renderer(moved(small(VolSDFField)), StratifiedSampler(4), quadrature="linear")
