"""Rules for density between samples: closed forms, orders of convergence, invariances."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.timing import fitted_order
from dnerf.core.compositing import FieldOutput, Rendering, composite
from dnerf.core.quadrature import RULES, optical_depths
from dnerf.core.rays import Samples

DOUBLE = torch.float64
layouts = pytest.mark.parametrize("packed", [False, True], ids=["dense", "packed"])


def uniform(num_samples: int, near: float = 0.0, far: float = 1.0, num_rays: int = 1) -> Samples:
    edges = torch.linspace(near, far, num_samples + 1, dtype=DOUBLE).expand(num_rays, -1)
    return Samples(edges[:, :-1], edges[:, 1:], num_rays)


def uneven(num_rays: int, num_samples: int, random_points: bool = False, seed: int = 0) -> Samples:
    generator = torch.Generator().manual_seed(seed)
    lengths = 0.1 + torch.rand(num_rays, num_samples, generator=generator, dtype=DOUBLE)
    ends = 1 + lengths.cumsum(-1)
    starts = torch.cat([torch.ones(num_rays, 1, dtype=DOUBLE), ends[:, :-1]], dim=-1)
    points = torch.lerp(starts, ends, torch.rand(starts.shape, generator=generator, dtype=DOUBLE))
    return Samples(starts, ends, num_rays, points=points if random_points else None)


def render(samples: Samples, density: Tensor, rgb: Tensor, rule: str, packed: bool = False) -> Rendering:
    if packed:
        return composite(samples.packed(), FieldOutput(density.flatten(), rgb.flatten(0, 1)), quadrature=rule)
    return composite(samples, FieldOutput(density, rgb), quadrature=rule)


@layouts
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("num_samples", [1, 2, 3, 17])
def test_constant_density_and_colour_are_exact(rule: str, packed: bool, num_samples: int) -> None:
    samples = uneven(5, num_samples, random_points=True)
    density = torch.full_like(samples.starts, 0.7)
    rendering = render(samples, density, torch.full((5, num_samples, 3), 0.25, dtype=DOUBLE), rule, packed)
    length = samples.ends[:, -1] - samples.starts[:, 0]
    opacity = -torch.expm1(-0.7 * length)
    torch.testing.assert_close(rendering.opacity, opacity, rtol=1e-13, atol=0)
    torch.testing.assert_close(rendering.rgb[:, 0], 0.25 * opacity, rtol=1e-13, atol=0)


@layouts
def test_linear_density_is_exact_between_points_wherever_they_lie(packed: bool) -> None:
    samples = uneven(8, 9, random_points=True)
    # Beyond the first and last point density is held: compare what lies between.
    samples = replace(
        samples, points=torch.cat([samples.starts[:, :1], samples.points[:, 1:-1], samples.ends[:, -1:]], dim=-1)
    )
    density = 2 + 3 * samples.distances
    rendering = render(samples, density, torch.ones(8, 9, 3, dtype=DOUBLE), "linear", packed)
    a, b = samples.starts[:, 0], samples.ends[:, -1]
    exact = -torch.expm1(-(2 * (b - a) + 1.5 * (b * b - a * a)))
    torch.testing.assert_close(rendering.opacity, exact, rtol=1e-13, atol=0)


def test_parabolas_have_their_exact_optical_depth_on_even_and_uneven_intervals() -> None:
    for samples in (uniform(12, 0.0, 2.0), uneven(1, 12)):
        t = samples.distances
        depth, _ = optical_depths(5 - 2 * t + 0.7 * t * t, samples, "parabolic")

        def integral(x: Tensor) -> Tensor:
            return 5 * x - x * x + 0.7 / 3 * x**3

        exact = integral(samples.ends) - integral(samples.starts)
        # Second differences are exact for parabolas, slopes cancel in the middle.
        torch.testing.assert_close(depth[:, 1:-1], exact[:, 1:-1], rtol=1e-13, atol=0)


def smooth_errors(rule: str, counts: list[int], sharpness: float = 3.0) -> list[float]:
    """Errors of colour through a Gaussian cloud whose colour changes along the ray; truth with 20000 intervals."""

    def color(num_samples: int, by: str) -> Tensor:
        samples = uniform(num_samples, -3.0, 3.0)
        t = samples.distances
        density = sharpness * torch.exp(-(t**2) / 0.5)
        rgb = torch.stack([0.5 + 0.5 * torch.sin(2 * t), 0.5 + 0.4 * torch.cos(3 * t + 1), torch.sigmoid(t)], dim=-1)
        return render(samples, density, rgb, by).rgb

    truth = color(20000, "parabolic")
    return [float((color(n, rule) - truth).abs().max()) for n in counts]


@pytest.mark.parametrize(("rule", "order"), [("constant", 2.0), ("linear", 2.0), ("parabolic", 4.0)])
def test_orders_of_convergence_on_smooth_density_and_colour(rule: str, order: float) -> None:
    counts = [64, 128, 256, 512]
    assert fitted_order([float(n) for n in counts], smooth_errors(rule, counts)) > order - 0.1


def test_parabolic_rule_needs_less_than_half_the_samples_of_midpoints_on_smooth_density() -> None:
    for sharpness in (0.5, 3.0, 10.0):
        for n in (16, 32, 64, 128):
            assert smooth_errors("parabolic", [n], sharpness)[0] < smooth_errors("constant", [2 * n], sharpness)[0]


@layouts
@pytest.mark.parametrize("rule", RULES)
@given(seed=st.integers(0, 2**31), num_samples=st.integers(1, 12), random_points=st.booleans())
def test_weights_are_positive_and_absorb_what_does_not_pass(
    rule: str, packed: bool, seed: int, num_samples: int, random_points: bool
) -> None:
    samples = uneven(200, num_samples, random_points, seed)
    generator = torch.Generator().manual_seed(seed)
    density = 10 ** (12 * torch.rand(200, num_samples, generator=generator, dtype=DOUBLE) - 8)
    density = density * (torch.rand(density.shape, generator=generator) > 0.3)
    rgb = torch.rand(200, num_samples, 3, generator=generator, dtype=DOUBLE)
    rendering = render(samples, density, rgb, rule, packed)
    depth, _ = optical_depths(density, samples, rule)
    assert (depth >= 0).all()
    assert (rendering.weights >= -1e-15).all()
    torch.testing.assert_close(rendering.opacity, -torch.expm1(-depth.sum(-1)), rtol=1e-12, atol=1e-300)
    assert (rendering.rgb <= rendering.opacity[:, None] + 1e-12).all()
    other = render(samples, density, rgb, rule, not packed)
    torch.testing.assert_close(rendering.rgb, other.rgb, rtol=0, atol=1e-13)


@pytest.mark.parametrize("rule", ["linear", "parabolic"])
def test_packed_rays_and_gaps_do_not_see_each_other(rule: str) -> None:
    samples = uniform(6, num_rays=2)
    mask = torch.tensor([[1, 1, 0, 0, 1, 1], [1, 1, 1, 1, 1, 1]], dtype=torch.bool)
    density = torch.tensor([[1.0, 1, 9, 9, 5, 5], [0, 0, 7, 7, 0, 0]], dtype=DOUBLE)
    packed = samples.packed(mask)
    depth, _ = optical_depths(density[mask], packed, rule)
    torch.testing.assert_close(depth[:4], torch.tensor([1.0, 1, 5, 5], dtype=DOUBLE) / 6)
    alone, _ = optical_depths(density[1:], uniform(6), rule)
    torch.testing.assert_close(depth[4:], alone[0])


@layouts
@pytest.mark.parametrize("rule", ["linear", "parabolic"])
@pytest.mark.parametrize("random_points", [False, True])
def test_gradcheck(rule: str, packed: bool, random_points: bool) -> None:
    samples = uneven(2, 5, random_points)
    density = torch.tensor([[0.3, 2.0, 0.5, 4.0, 1e-3], [1.0, 0.9, 0.8, 9.0, 30.0]], dtype=DOUBLE, requires_grad=True)
    rgb = torch.rand(2, 5, 3, dtype=DOUBLE, requires_grad=True)

    def outputs(d: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r = render(samples, d, c, rule, packed)
        return r.rgb, r.opacity, r.depth

    assert torch.autograd.gradcheck(outputs, (density, rgb))


@pytest.mark.parametrize("rule", ["linear", "parabolic"])
def test_float32_agrees_with_float64(rule: str) -> None:
    samples = uneven(3000, 32, random_points=True)
    single = replace(samples, **{n: getattr(samples, n).float() for n in ("starts", "ends", "points")})
    double = replace(single, **{n: getattr(single, n).double() for n in ("starts", "ends", "points")})
    density, rgb = 10 ** (10 * torch.rand(3000, 32) - 8), torch.rand(3000, 32, 3)
    rounded = render(single, density, rgb, rule)
    exact = render(double, density.double(), rgb.double(), rule)
    # Lengths are differences of distances near 10, known to 1e-6, of which the shortest part is 1e-2 or so.
    assert ((rounded.opacity.double() - exact.opacity).abs() / exact.opacity).max() < 2e-5
    assert (rounded.rgb.double() - exact.rgb).abs().max() < 2e-5


@pytest.mark.parametrize("rule", RULES)
def test_padding_changes_no_image(rule: str) -> None:
    samples = uniform(5).packed()
    density = torch.tensor([0.3, 2, 1, 4, 0.5], dtype=DOUBLE)
    rgb = torch.rand(5, 3, dtype=DOUBLE)
    plain = composite(samples, FieldOutput(density, rgb), quadrature=rule)
    # The field says of padding what it says where the last sample ends: anything.
    more = FieldOutput(torch.cat([density, density.new_full((3,), 7.0)]), torch.cat([rgb, rgb.new_ones(3, 3)]))
    padded = composite(samples.padded(8), more, quadrature=rule)
    torch.testing.assert_close(padded.rgb, plain.rgb, rtol=0, atol=1e-15)
    torch.testing.assert_close(padded.opacity, plain.opacity, rtol=0, atol=1e-15)


def test_unknown_rule_is_named() -> None:
    with pytest.raises(ValueError, match="quadrature must be one of constant, linear, parabolic; got 'simpson'"):
        composite(uniform(2), FieldOutput(torch.ones(1, 2), torch.ones(1, 2, 3)), quadrature="simpson")


def test_thin_light_is_absorbed_in_the_middle_and_dense_light_at_the_front() -> None:
    samples = uniform(3, 0.0, 3.0)
    for density, shift in ((1e-6, 0.0), (1e6, 0.5)):
        full = torch.full((1, 3), density, dtype=DOUBLE)
        _, shares = optical_depths(full, samples, "parabolic")
        assert (shares.before - shares.after)[0, 1].item() == pytest.approx(shift, abs=1e-6)
        assert shares.before[0, 0].item() == 0
