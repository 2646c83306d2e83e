"""Compositing against closed forms, a brute-force loop, and its own invariances; dense and packed alike."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference import composite_ray, ray_weights
from torch import Tensor

from dnerf.core.compositing import (
    FieldOutput,
    Rendering,
    composite,
    median_depth,
    render_weights,
    safe_divide,
    sum_along_rays,
)
from dnerf.core.quadrature import RULES
from dnerf.core.rays import Samples

# What the issue asks of opacity: float64 to 1e-12, float32 to 1e-6, both relative.
PRECISION = {torch.float64: 1e-12, torch.float32: 1e-6}
DTYPES = [torch.float64, torch.float32]

both_layouts = pytest.mark.parametrize("layout", ["dense", "packed"])


def uniform(
    near: float, far: float, num_samples: int, dtype: torch.dtype = torch.float64, num_rays: int = 1
) -> Samples:
    """Equal intervals between near and far, dense."""
    edges = torch.linspace(near, far, num_samples + 1, dtype=dtype).expand(num_rays, -1)
    return Samples(edges[:, :-1], edges[:, 1:], num_rays)


def render(
    layout: str, samples: Samples, density: Tensor, rgb: Tensor | None = None, background: Tensor | None = None,
    quadrature: str = "constant",
) -> Rendering:  # fmt: skip
    """Composite dense samples, as they are or packed."""
    if rgb is None:
        rgb = torch.ones_like(density)[..., None].expand(*density.shape, 3)
    if layout == "packed":
        samples, density, rgb = samples.packed(), density.flatten(), rgb.flatten(0, 1)
    return composite(samples, FieldOutput(density, rgb), background, quadrature=quadrature)


def weights_of(layout: str, optical_depth: Tensor) -> Tensor:
    """Weights (R, S) of optical depths (R, S), through either layout."""
    samples = uniform(0, 1, optical_depth.shape[1], torch.float64, optical_depth.shape[0])
    if layout == "packed":
        return render_weights(optical_depth.flatten(), samples.packed()).unflatten(0, optical_depth.shape)
    return render_weights(optical_depth, samples)


def random_scene(num_rays: int, num_samples: int, seed: int = 0) -> tuple[Samples, Tensor, Tensor, Tensor]:
    """Samples, density, rgb and background with uneven intervals, in float64."""
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(num_rays, num_samples + 1, generator=generator, dtype=torch.float64).cumsum(-1)
    density = 2 * torch.rand(num_rays, num_samples, generator=generator, dtype=torch.float64) ** 3
    rgb = torch.rand(num_rays, num_samples, 3, generator=generator, dtype=torch.float64)
    background = torch.rand(num_rays, 3, generator=generator, dtype=torch.float64)
    return Samples(edges[:, :-1], edges[:, 1:], num_rays), density, rgb, background


@both_layouts
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("num_samples", [1, 2, 7, 64, 1000])
@pytest.mark.parametrize("density", [1e-12, 3e-8, 1e-3, 0.9, 30.0])
def test_constant_density_has_exact_opacity_for_any_number_of_samples(
    layout: str, dtype: torch.dtype, num_samples: int, density: float
) -> None:
    samples = uniform(2, 4, num_samples, dtype)
    opacity = render(layout, samples, torch.full_like(samples.starts, density)).opacity
    assert opacity.dtype == dtype
    assert opacity.item() == pytest.approx(-math.expm1(-density * 2), rel=PRECISION[dtype])


@both_layouts
def test_expected_depth_converges_with_second_order(layout: str) -> None:
    near, far, density = 1.0, 5.0, 1.3
    absorbed = -math.expm1(-density * 4)
    exact = near + (absorbed - math.exp(-density * 4) * density * 4) / density / absorbed
    counts = [16, 32, 64, 128, 256]
    errors = []
    for count in counts:
        samples = uniform(near, far, count)
        errors.append(abs(render(layout, samples, torch.full_like(samples.starts, density)).depth.item() - exact))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    # The next term of the error is of fourth order, which bends the fit by less than this.
    assert order == pytest.approx(2, abs=0.02)
    assert errors[-1] < 1e-3


@both_layouts
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("num_samples", [1, 3, 50])
def test_linear_density_has_exact_opacity(layout: str, dtype: torch.dtype, num_samples: int) -> None:
    samples = uniform(1, 3, num_samples, dtype)
    opacity = render(layout, samples, 0.25 + 0.5 * (samples.distances - 1)).opacity
    assert opacity.item() == pytest.approx(-math.expm1(-(0.25 * 2 + 0.25 * 4)), rel=PRECISION[dtype])


@both_layouts
def test_gaussian_blob_has_the_optical_depth_of_its_error_function(layout: str) -> None:
    near, far, center, width, peak = 2.0, 4.5, 3.0, 0.3, 4.0
    scale = width * math.sqrt(2)
    depth = (
        peak * width * math.sqrt(math.pi / 2) * (math.erf((far - center) / scale) - math.erf((near - center) / scale))
    )
    errors = []
    for count in (200, 400):
        samples = uniform(near, far, count)
        density = peak * torch.exp(-0.5 * ((samples.distances - center) / width) ** 2)
        errors.append(abs(render(layout, samples, density).opacity.item() + math.expm1(-depth)))
    # Cut at 3.3 widths, the blob's slope at the ends is small but not zero: second order with a tiny constant.
    assert errors[0] < 1e-6
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.01)


@both_layouts
def test_swapping_two_slabs_changes_the_colour_by_the_closed_form(layout: str) -> None:
    red, blue = torch.tensor([1.0, 0, 0], dtype=torch.float64), torch.tensor([0, 0, 1.0], dtype=torch.float64)
    samples = uniform(0, 2, 40)
    first = samples.distances < 1
    density = torch.full_like(samples.starts, 1.7).masked_fill(first, 0.4)
    rgb = torch.where(first[..., None], red, blue)
    forward = render(layout, samples, density, rgb)
    backward = render(layout, samples, density.flip(-1), rgb.flip(1))
    red_alone, blue_alone = -math.expm1(-0.4), -math.expm1(-1.7)
    expected = torch.tensor([[red_alone, 0, (1 - red_alone) * blue_alone]], dtype=torch.float64)
    torch.testing.assert_close(forward.rgb, expected, rtol=0, atol=1e-12)
    # Each colour loses exactly what the other slab absorbs before it.
    change = torch.tensor([[red_alone * blue_alone, 0, -red_alone * blue_alone]], dtype=torch.float64)
    torch.testing.assert_close(forward.rgb - backward.rgb, change, rtol=0, atol=1e-12)
    torch.testing.assert_close(forward.opacity, backward.opacity, rtol=1e-12, atol=0)


unit = st.floats(0, 1)
intervals = st.lists(
    st.tuples(
        # Products of smaller numbers have fewer digits, and quotients of those fewer still.
        st.one_of(st.just(0.0), st.floats(1e-100, 2)),
        st.one_of(st.just(0.0), st.floats(1e-100, 1e3)),
        st.tuples(unit, unit, unit),
    ),
    max_size=6,
)


@given(rays=st.lists(st.tuples(intervals, st.tuples(unit, unit, unit)), max_size=4))
def test_packed_rays_agree_with_a_loop(rays: list) -> None:
    starts, ends, densities, colors, indices, pixels = [], [], [], [], [], []
    for r, (row, background) in enumerate(rays):
        edges = np.cumsum([1.0, *(length for length, _, _ in row)]).tolist()
        starts += edges[:-1]
        ends += edges[1:]
        densities += [density for _, density, _ in row]
        colors += [color for _, _, color in row]
        indices += [r] * len(row)
        pixels.append(composite_ray(edges[:-1], edges[1:], [d for _, d, _ in row], [c for _, _, c in row], background))
    as_tensor = lambda values, *shape: torch.tensor(values, dtype=torch.float64).reshape(*shape)  # noqa: E731
    samples = Samples(
        as_tensor(starts, -1), as_tensor(ends, -1), len(rays), ray_indices=torch.tensor(indices, dtype=torch.int64)
    )
    rendering = composite(
        samples,
        FieldOutput(as_tensor(densities, -1), as_tensor(colors, -1, 3)),
        as_tensor([background for _, background in rays], -1, 3),
    )
    # Sums of at most six terms of size one.
    torch.testing.assert_close(rendering.rgb, as_tensor([p.rgb for p in pixels], -1, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(rendering.opacity, as_tensor([p.opacity for p in pixels], -1), rtol=1e-13, atol=0)
    torch.testing.assert_close(rendering.depth, as_tensor([p.depth for p in pixels], -1), rtol=1e-13, atol=0)


@given(row=intervals)
def test_dense_ray_agrees_with_a_loop(row: list) -> None:
    edges = np.cumsum([1.0, *(length for length, _, _ in row)])
    tensor = torch.from_numpy(edges)[None]
    density = torch.tensor([[d for _, d, _ in row]], dtype=torch.float64)
    rgb = torch.tensor([c for _, _, c in row], dtype=torch.float64).reshape(1, -1, 3)
    white = torch.ones(3, dtype=torch.float64)
    rendering = composite(Samples(tensor[:, :-1], tensor[:, 1:], 1), FieldOutput(density, rgb), white)
    pixel = composite_ray(edges[:-1], edges[1:], density[0].tolist(), rgb[0].tolist(), (1, 1, 1))
    torch.testing.assert_close(rendering.rgb[0].tolist(), pixel.rgb, rtol=0, atol=1e-14)
    assert rendering.opacity.item() == pytest.approx(pixel.opacity, rel=1e-13)
    assert rendering.depth.item() == pytest.approx(pixel.depth, rel=1e-13)


def test_dropping_empty_samples_from_packed_rays_changes_nothing() -> None:
    samples, density, rgb, background = random_scene(20, 30)
    mask = torch.rand(20, 30) < 0.4
    mask[3] = False
    dense = composite(samples, FieldOutput(density * mask, rgb), background)
    packed = composite(samples.packed(mask), FieldOutput(density[mask], rgb[mask]), background)
    for name in ("rgb", "opacity", "depth"):
        torch.testing.assert_close(getattr(dense, name), getattr(packed, name), rtol=1e-13, atol=1e-15)
    assert torch.equal(packed.rgb[3], background[3])


@both_layouts
def test_splitting_an_interval_changes_nothing(layout: str) -> None:
    samples, density, rgb, background = random_scene(5, 8)
    cut = torch.lerp(samples.starts, samples.ends, torch.rand_like(samples.starts))
    starts = torch.stack([samples.starts, cut], -1).flatten(1)
    ends = torch.stack([cut, samples.ends], -1).flatten(1)
    whole = render(layout, samples, density, rgb, background)
    split = render(
        layout, Samples(starts, ends, 5), density.repeat_interleave(2, 1), rgb.repeat_interleave(2, 1), background
    )
    torch.testing.assert_close(whole.rgb, split.rgb, rtol=1e-12, atol=0)
    torch.testing.assert_close(whole.opacity, split.opacity, rtol=1e-12, atol=0)


@both_layouts
@pytest.mark.parametrize("thickness", [1e9, math.inf])
@pytest.mark.parametrize("quadrature", RULES)
def test_zero_length_intervals_add_nothing(layout: str, thickness: float, quadrature: str) -> None:
    samples, density, rgb, background = random_scene(5, 8)
    starts = torch.cat([samples.starts[:, :4], samples.starts[:, 4:5], samples.starts[:, 4:]], 1)
    ends = torch.cat([samples.ends[:, :4], samples.starts[:, 4:5], samples.ends[:, 4:]], 1)
    thick = torch.cat([density[:, :4], torch.full((5, 1), thickness, dtype=torch.float64), density[:, 4:]], 1)
    bright = torch.cat([rgb[:, :4], torch.ones(5, 1, 3, dtype=torch.float64), rgb[:, 4:]], 1)
    # Rules that look at neighbours find none across it: the ray is then one of two halves.
    plain = [render(layout, samples, density, rgb, background)] if quadrature == "constant" else []
    leaves = [x.requires_grad_() for x in (starts, ends, thick, bright)]
    longer = render(layout, Samples(*leaves[:2], 5), *leaves[2:], background, quadrature=quadrature)
    for name in ("rgb", "opacity", "depth"):
        assert torch.isfinite(getattr(longer, name)).all()
        for expected in plain:
            torch.testing.assert_close(getattr(expected, name), getattr(longer, name), rtol=1e-14, atol=0)
    (longer.rgb.sum() + longer.depth.sum()).backward()
    for leaf in leaves:
        assert torch.isfinite(leaf.grad).all()


@both_layouts
def test_gradients_to_density_and_colour_have_their_closed_forms(layout: str) -> None:
    samples, density, rgb, background = random_scene(4, 6)
    density.requires_grad_()
    rgb.requires_grad_()
    rendering = render(layout, samples, density, rgb, background)
    rendering.rgb[:, 1].sum().backward()
    depth = (density * samples.lengths).detach()
    weights = torch.tensor([ray_weights(row) for row in depth.tolist()], dtype=torch.float64)
    torch.testing.assert_close(rgb.grad[..., 1], weights, rtol=1e-12, atol=1e-15)
    assert torch.count_nonzero(rgb.grad[..., 0]) == 0
    color = rgb.detach()[..., 1]
    expected = torch.zeros_like(density)
    for j in range(6):
        after = torch.exp(-depth[:, : j + 1].sum(-1))
        behind = (weights * color)[:, j + 1 :].sum(-1) + torch.exp(-depth.sum(-1)) * background[:, 1]
        expected[:, j] = samples.lengths[:, j] * (after * color[:, j] - behind)
    torch.testing.assert_close(density.grad, expected, rtol=1e-11, atol=1e-15)


@both_layouts
@pytest.mark.parametrize("densities", [
    pytest.param([1e-9, 1e-7, 2e-8, 1e-9], id="alpha to 0"),
    pytest.param([0.3, 25.0, 40.0, 0.1], id="alpha to 1"),
    pytest.param([0.0, 0.5, 0.0, 1.0], id="density 0 in places"),
    pytest.param([0.2, 1.0, 0.4, 2.0], id="plain"),
])  # fmt: skip
def test_gradcheck_of_colour_opacity_and_depth(layout: str, densities: list[float]) -> None:
    samples = uniform(1, 5, 4)

    def outputs(density: Tensor, rgb: Tensor, background: Tensor) -> tuple[Tensor, ...]:
        rendering = render(layout, samples, density, rgb, background)
        # With hardly any density the mean depth is 0/0 within a finite difference of 1e-6.
        parts = (rendering.rgb, rendering.opacity)
        return parts if max(densities) < 1e-6 else (*parts, rendering.depth)

    density = torch.tensor([densities], dtype=torch.float64, requires_grad=True)
    rgb = torch.rand(1, 4, 3, dtype=torch.float64, requires_grad=True)
    background = torch.rand(1, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(outputs, (density, rgb, background))


@both_layouts
def test_gradcheck_of_colour_and_opacity_in_vacuum(layout: str) -> None:
    samples = uniform(1, 5, 3)
    rgb = torch.rand(1, 3, 3, dtype=torch.float64)
    density = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: render(layout, samples, s, rgb).rgb, (density,))
    assert torch.autograd.gradcheck(lambda s: render(layout, samples, s).opacity, (density,))


@both_layouts
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("wall", [0, 2, 4])
def test_infinite_density_is_a_wall_without_nan(layout: str, dtype: torch.dtype, wall: int) -> None:
    samples = uniform(0, 5, 5, dtype)
    density = torch.full((1, 5), 0.3, dtype=dtype)
    density[0, wall:] = torch.inf
    density.requires_grad_()
    rgb = torch.rand(1, 5, 3, dtype=dtype, requires_grad=True)
    rendering = render(layout, samples, density, rgb, torch.ones(3, dtype=dtype))
    (rendering.rgb.sum() + rendering.depth.sum() + rendering.opacity.sum()).backward()
    assert rendering.opacity.item() == pytest.approx(1, rel=PRECISION[dtype])
    expected = composite_ray(range(5), range(1, 6), [0.3] * wall + [1e300] * (5 - wall), rgb[0].tolist())
    assert rendering.rgb[0].tolist() == pytest.approx(expected.rgb, rel=PRECISION[dtype])
    assert rendering.depth.item() == pytest.approx(expected.depth, rel=PRECISION[dtype])
    assert torch.isfinite(density.grad).all()
    assert torch.isfinite(rgb.grad).all()
    assert torch.count_nonzero(density.grad[0, wall:]) == 0


@both_layouts
def test_thin_intervals_are_exact(layout: str) -> None:
    optical_depth = torch.tensor([[3e-8, 1e-12, 1e-30, 1e-6]])
    # 1 - exp(-x) gives 0, 0, 0 and 9.5e-7 here.
    torch.testing.assert_close(weights_of(layout, optical_depth), optical_depth, rtol=1.2e-6, atol=0)


@both_layouts
@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_half_precision_inputs_accumulate_in_float32(layout: str, half: torch.dtype) -> None:
    samples = uniform(2, 6, 512, torch.float32)
    density, rgb = torch.rand(1, 512).to(half), torch.rand(1, 512, 3).to(half)
    result = render(layout, samples, density, rgb, torch.ones(3))
    exact = render(layout, samples, density.float(), rgb.float(), torch.ones(3))
    for name in ("rgb", "opacity", "depth", "weights"):
        assert getattr(result, name).dtype == torch.float32
        assert torch.equal(getattr(result, name), getattr(exact, name))
    summed = sum_along_rays(rgb, samples)
    assert summed.dtype == torch.float32
    torch.testing.assert_close(summed, rgb.double().sum(1).float(), rtol=1e-6, atol=0)


@both_layouts
@pytest.mark.parametrize("num_samples", [0, 1, 5])
def test_empty_ray_shows_background(layout: str, num_samples: int) -> None:
    samples = Samples(torch.full((2, num_samples), 2.0), torch.full((2, num_samples), 2.0), 2)
    density = torch.full((2, num_samples), 7.0, requires_grad=True)
    background = torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
    rendering = render(layout, samples, density, torch.rand(2, num_samples, 3), background)
    assert torch.equal(rendering.rgb, background)
    assert torch.equal(rendering.opacity, torch.zeros(2))
    assert torch.equal(rendering.depth, torch.zeros(2))
    (rendering.rgb.sum() + rendering.depth.sum()).backward()
    assert torch.count_nonzero(density.grad) == 0


@both_layouts
def test_vacuum_has_depth_zero_and_finite_gradients(layout: str) -> None:
    samples = uniform(2, 6, 8, torch.float32)
    density = torch.zeros(1, 8, requires_grad=True)
    rendering = render(layout, samples, density)
    (rendering.depth.sum() + rendering.rgb.sum()).backward()
    assert rendering.depth.item() == 0
    assert torch.isfinite(density.grad).all()


def test_empty_packed_batch_shows_background() -> None:
    samples = Samples(torch.empty(0), torch.empty(0), 3, ray_indices=torch.empty(0, dtype=torch.int64))
    rendering = composite(samples, FieldOutput(torch.empty(0), torch.empty(0, 3)), torch.tensor([0.2, 0.4, 0.6]))
    torch.testing.assert_close(rendering.rgb, torch.tensor([[0.2, 0.4, 0.6]]).expand(3, 3), rtol=0, atol=0)
    assert torch.equal(rendering.opacity, torch.zeros(3))


@both_layouts
def test_batch_without_rays_gives_no_pixels(layout: str) -> None:
    samples = Samples(torch.empty(0, 4), torch.empty(0, 4), 0)
    rendering = render(layout, samples, torch.empty(0, 4), torch.empty(0, 4, 3), torch.ones(3))
    assert rendering.rgb.shape == (0, 3)
    assert rendering.depth.shape == (0,)


@both_layouts
def test_no_background_is_black(layout: str) -> None:
    samples, density, rgb, background = random_scene(3, 5)
    black = render(layout, samples, density, rgb)
    lit = render(layout, samples, density, rgb, background)
    assert black.background is None
    torch.testing.assert_close(lit.rgb - black.rgb, (1 - black.opacity)[:, None] * background, rtol=0, atol=1e-15)


@both_layouts
def test_depth_is_taken_where_the_field_was_evaluated(layout: str) -> None:
    samples = replace(uniform(0, 4, 4), points=torch.tensor([[0.1, 1.9, 2.2, 3.0]], dtype=torch.float64))
    density = torch.tensor([[0.0, 1e9, 0.0, 0.0]], dtype=torch.float64)
    assert render(layout, samples, density).depth.item() == pytest.approx(1.9, rel=1e-15)


@both_layouts
@pytest.mark.parametrize("trailing", [(), (3,), (2, 2)])
@pytest.mark.parametrize("weighted", [False, True])
def test_sums_along_rays_agree_with_a_loop(layout: str, trailing: tuple[int, ...], weighted: bool) -> None:
    mask = torch.tensor([[1, 1, 0, 1], [0, 0, 0, 0], [0, 1, 1, 1]], dtype=torch.bool)
    dense = uniform(0, 1, 4, num_rays=3)
    values, weights = torch.rand(3, 4, *trailing, dtype=torch.float64), torch.rand(3, 4, dtype=torch.float64)
    if layout == "dense":
        mask = torch.ones_like(mask)
    expected = torch.zeros(3, *trailing, dtype=torch.float64)
    for r, s in mask.nonzero().tolist():
        expected[r] += values[r, s] * (weights[r, s] if weighted else 1)
    if layout == "packed":
        result = sum_along_rays(values[mask], dense.packed(mask), weights[mask] if weighted else None)
    else:
        result = sum_along_rays(values, dense, weights if weighted else None)
    torch.testing.assert_close(result, expected, rtol=1e-14, atol=0)


@both_layouts
@pytest.mark.parametrize("num_samples", [16, 64, 256])
def test_half_of_the_light_is_lost_where_the_closed_form_says(layout: str, num_samples: int) -> None:
    """In constant density on (1, 5): 1 + log(2 / (1 + exp(-4 sigma))) / sigma, up to a sample's length squared."""
    density = torch.tensor([[0.01], [0.5], [2.0]], dtype=torch.float64)
    samples = uniform(1, 5, num_samples, num_rays=3)
    found = median_depth(render(layout, samples, density.expand(3, num_samples)))
    expected = 1 + torch.log(2 / (1 + torch.exp(-4 * density))) / density
    torch.testing.assert_close(found, expected[:, 0], rtol=0, atol=(4 / num_samples) ** 2)


@both_layouts
def test_median_depth_at_an_edge_lies_on_one_side(layout: str) -> None:
    """Half-covered by a wall at 1 before one at 3: the expected depth is between, the median where more light is."""
    samples = uniform(0, 4, 40, num_rays=2)
    density = torch.zeros(2, 40, dtype=torch.float64)
    density[:, 10] = torch.tensor([10 * math.log(1 / 0.4), 10 * math.log(1 / 0.6)])  # absorbs 0.6 and 0.4
    density[:, 30] = 1e4
    rendering = render(layout, samples, density)
    assert ((rendering.depth > 1.2) & (rendering.depth < 2.9)).all()
    near, far = median_depth(rendering).tolist()
    assert 1.0 < near < 1.1
    assert 3.0 < far < 3.1


@both_layouts
def test_median_depth_of_vacuum_is_zero(layout: str) -> None:
    density = torch.zeros(3, 8, dtype=torch.float64)
    density[1, 4] = 1e-9
    found = median_depth(render(layout, uniform(1, 3, 8, num_rays=3), density))
    assert found.tolist() == pytest.approx([0.0, 2.125, 0.0], abs=1e-9)
    nothing = Samples(*(torch.zeros(0) for _ in range(2)), 2, ray_indices=torch.zeros(0, dtype=torch.int64))
    assert median_depth(composite(nothing, FieldOutput(torch.zeros(0), torch.zeros(0, 3)))).tolist() == [0.0, 0.0]


@both_layouts
def test_median_depth_of_faint_and_broken_rays_is_their_own(layout: str) -> None:
    """A ray that absorbs next to nothing is as exact behind twenty thousand opaque ones, and NaN stays where it is."""
    density = torch.full((20_002, 4), 50.0, dtype=torch.float64)
    density[0] = torch.nan
    density[-1] = torch.tensor([0, 1e-12, 0, 0])
    found = median_depth(render(layout, uniform(0, 2, 4, num_rays=len(density)), density))
    assert bool(found[0].isnan())
    expected = math.log(2 / (1 + math.exp(-100))) / 50  # the closed form; within a sample light is absorbed evenly
    torch.testing.assert_close(found[1:-1], torch.full_like(found[1:-1], found[1]), rtol=0, atol=1e-9)
    assert abs(float(found[1]) - expected) < 0.5
    assert float(found[-1]) == pytest.approx(0.75, abs=1e-9)


def test_median_depth_of_a_whole_image_is_refused() -> None:
    with pytest.raises(ValueError, match="rendering must have per-sample data"):
        median_depth(Rendering(rgb=torch.zeros(2, 3), opacity=torch.zeros(2), depth=torch.zeros(2)))


def test_safe_division_by_zero_is_zero_with_zero_gradient() -> None:
    numerator = torch.tensor([0.0, 1.0, 3.0], requires_grad=True)
    denominator = torch.tensor([0.0, 0.0, 2.0], requires_grad=True)
    quotient = safe_divide(numerator, denominator)
    quotient.sum().backward()
    assert quotient.tolist() == [0, 0, 1.5]
    assert numerator.grad.tolist() == [0, 0, 0.5]
    assert denominator.grad.tolist() == [0, 0, -0.75]


def composite_shapes(density: tuple[int, ...], rgb: tuple[int, ...], background: tuple[int, ...]) -> Rendering:
    return composite(
        uniform(0, 1, 4, num_rays=2), FieldOutput(torch.ones(density), torch.ones(rgb)), torch.ones(background)
    )


PAIR = uniform(0, 1, 4, num_rays=2)


@pytest.mark.parametrize(("call", "message"), [
    (lambda: composite_shapes((2, 3), (2, 4, 3), (3,)), "density must have shape (2, 4), got (2, 3)"),
    (lambda: composite_shapes((2, 4, 1), (2, 4, 3), (3,)), "density must have shape (2, 4), got (2, 4, 1)"),
    (lambda: composite_shapes((2, 4), (2, 4), (3,)), "rgb must have shape (2, 4, 3), got (2, 4)"),
    (lambda: composite_shapes((2, 4), (2, 4, 3), (4, 3)), "background must have shape (2, 3), got (4, 3)"),
    (lambda: composite_shapes((2, 4), (2, 4, 3), (1,)), "background must have shape (2, 3), got (1,)"),
    (lambda: render_weights(torch.ones(8), PAIR), "optical_depth must have shape (2, 4), got (8,)"),
    (lambda: sum_along_rays(torch.ones(4, 2), PAIR), "values must have shape (2, 4, ...), got (4, 2)"),
    (lambda: sum_along_rays(torch.ones(2, 4), PAIR, torch.ones(2)), "weights must have shape (2, 4), got (2,)"),
])  # fmt: skip
def test_shapes_that_do_not_fit_are_named(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError) as error:
        call()
    assert str(error.value) == message
