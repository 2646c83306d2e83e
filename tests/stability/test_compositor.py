"""The compositor in float32 against float64: any optical depth from 1e-12 to 1e6, up to 4096 samples, no NaN ever."""

import math

import pytest
import torch
from cases import image, random_depths, relative, unit_samples, value_and_gradients
from hypothesis import given
from hypothesis import strategies as st

from dnerf.core.compositing import FieldOutput, composite
from dnerf.core.quadrature import RULES
from dnerf.core.rays import Samples

BOUND = 1e-6
"""Relative error that the project promises of colour, opacity and depth in float32."""

layouts = pytest.mark.parametrize("packed", [False, True], ids=["dense", "packed"])


def batch(num_rays: int, num_samples: int, seed: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed + 1)
    rgb = torch.rand(num_rays, num_samples, 3, generator=generator)
    return random_depths(num_rays, num_samples, seed), rgb, torch.rand(num_rays, 3, generator=generator)


@layouts
@pytest.mark.parametrize(("num_rays", "num_samples"), [(12000, 1), (12000, 24), (1500, 256), (90, 4096)])
def test_float32_images_are_exact_to_1e_6(packed: bool, num_rays: int, num_samples: int) -> None:
    depths, rgb, background = batch(num_rays, num_samples, num_samples)
    dark = torch.zeros(3)
    rounded, exact = image(depths, rgb, dark, packed), image(depths.double(), rgb.double(), dark.double(), packed)
    for name in ("rgb", "opacity", "depth"):
        assert relative(getattr(rounded, name), getattr(exact, name)).max() < BOUND, name
    # What is left of the background behind an opaque ray, 1 - opacity, is known to the rounding of 1.
    behind = image(depths, rgb, background, packed).rgb.double()
    truth = image(depths.double(), rgb.double(), background.double(), packed).rgb
    assert (behind - truth).abs().max() < BOUND


@layouts
@pytest.mark.parametrize(("num_rays", "num_samples"), [(12000, 24), (90, 4096)])
def test_float32_gradients_are_exact_to_rounding(packed: bool, num_rays: int, num_samples: int) -> None:
    depths, rgb, background = batch(num_rays, num_samples, 7 * num_samples)

    def color(*inputs: torch.Tensor) -> torch.Tensor:
        return image(*inputs, packed).rgb

    _, rounded = value_and_gradients(color, depths, rgb, background)
    _, exact = value_and_gradients(color, *(x.double() for x in (depths, rgb, background)))
    # dC/d tau_j is a difference of light in front of and behind j: its error is relative to the terms, all <= 3 T_j
    # for three colours. Exponents x up to 88 have an error of 6e-8 x, worth at most 6e-8 x exp(-x) <= 2.2e-8.
    for a, b in zip(rounded, exact):
        assert (a.double() - b).abs().max() < 3 * BOUND


@layouts
def test_gradients_of_thin_rays_are_relative_to_their_size(packed: bool) -> None:
    depths = 10 ** (-12 + 8 * torch.rand(6000, 16))
    rgb, background = torch.rand(6000, 16, 3), torch.rand(6000, 3)

    def opacity(depth: torch.Tensor) -> torch.Tensor:
        return image(depth, rgb.to(depth.dtype), background.to(depth.dtype), packed).opacity

    _, (rounded,) = value_and_gradients(opacity, depths)
    _, (exact,) = value_and_gradients(opacity, depths.double())
    assert relative(rounded, exact).max() < BOUND


@layouts
@pytest.mark.parametrize("quadrature", RULES)
@given(
    seed=st.integers(0, 2**31),
    magnitude=st.sampled_from([1e-45, 1e-38, 1e-12, 1.0, 1e6, 1e20, 3e38]),
    length=st.sampled_from([0.0, 1e-38, 1e-6, 1.0, 1e30]),
    num_samples=st.integers(1, 40),
)
def test_no_finite_input_makes_a_nan_or_an_infinity(
    packed: bool, quadrature: str, seed: int, magnitude: float, length: float, num_samples: int
) -> None:
    # Fifty examples of 400 rays in two layouts and three rules: a hundred thousand generated rays.
    generator = torch.Generator().manual_seed(seed)
    density = magnitude * torch.rand(400, num_samples, generator=generator)
    density = density * (torch.rand(density.shape, generator=generator) > 0.2)
    lengths = length * torch.rand(density.shape, generator=generator)
    ends = lengths.cumsum(-1)
    starts = torch.cat([torch.zeros(400, 1), ends[:, :-1]], dim=-1)
    rgb = torch.rand(400, num_samples, 3, generator=generator)

    def render(d: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        samples = Samples(starts, ends, 400)
        if packed:
            r = composite(
                samples.packed(), FieldOutput(d.flatten(), c.flatten(0, 1)), torch.ones(3), quadrature=quadrature
            )
        else:
            r = composite(samples, FieldOutput(d, c), torch.ones(3), quadrature=quadrature)
        assert (r.opacity >= 0).all()
        assert (r.opacity <= 1).all()
        return torch.cat([r.rgb, r.opacity[:, None], r.depth[:, None]], dim=-1)

    value, gradients = value_and_gradients(render, density, rgb)
    assert torch.isfinite(value).all()
    for gradient in gradients[: 2 if length <= 1 else 0]:  # d/d density is a length: 1e30 times 1e38 may overflow
        assert torch.isfinite(gradient).all()


@layouts
@pytest.mark.parametrize("depth", [20.0, 104.0, 1e6, math.inf])
def test_wall_at_the_first_sample_hides_everything_and_lets_no_gradient_through(packed: bool, depth: float) -> None:
    depths = torch.rand(50, 8)
    depths[:, 0] = depth
    rgb = torch.rand(50, 8, 3)

    def color(d: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        return image(d, c, torch.ones(3), packed).rgb

    value, (to_depth, to_rgb) = value_and_gradients(color, depths, rgb)
    left = math.exp(-depth)
    assert (value - rgb[:, 0]).abs().max() <= left + 1e-7
    assert torch.isfinite(to_depth).all()
    assert to_depth[:, 1:].abs().max() <= 3 * left + 1e-30
    torch.testing.assert_close(to_rgb[:, 0], torch.ones(50, 3))


@layouts
def test_four_thousand_thin_samples_add_up_in_value_and_gradient(packed: bool) -> None:
    depths = torch.full((3, 4096), 1e-4)

    def opacity(d: torch.Tensor) -> torch.Tensor:
        return image(d, torch.ones(3, 4096, 3), torch.zeros(3), packed).opacity

    value, (gradient,) = value_and_gradients(opacity, depths)
    total = 4096 * float(torch.tensor(1e-4))  # the float32 nearest to 1e-4
    assert relative(value, torch.tensor(-math.expm1(-total))).max() < BOUND
    assert relative(gradient, torch.tensor(math.exp(-total))).max() < BOUND


def test_rays_of_very_different_depth_do_not_disturb_each_other_when_packed() -> None:
    depths = torch.cat([torch.full((1, 64), 1e5), torch.full((1, 64), 1e-10)]).repeat(200, 1)
    samples = unit_samples(400, 64)
    thin = composite(samples.packed(), FieldOutput((128 * depths).flatten(), torch.ones(400 * 64, 3))).opacity[1::2]
    exact = -math.expm1(-64 * float(torch.tensor(1e-10)))
    assert relative(thin, torch.tensor(exact)).max() < BOUND
