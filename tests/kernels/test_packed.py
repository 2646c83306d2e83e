"""Weights and sums of packed samples: loops, compiled versions, gradients, hard numbers."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.backends import under

from dnerf import kernels
from dnerf.kernels import packed_sum, packed_weights

COUNTS = (0, 3, 1, 0, 200, 17, 0)


def packed(counts, scale=0.3, dtype=torch.float64, num_columns=3, device="cpu"):
    """Optical depths, values, weights and offsets of rays with so many samples."""
    generator = torch.Generator().manual_seed(0)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    depths, weights = torch.rand(2, int(offsets[-1]), generator=generator, dtype=torch.float64)
    values = torch.randn(len(depths), num_columns, generator=generator, dtype=torch.float64)
    return *(x.to(device, dtype) for x in (depths * scale, values, weights)), offsets.to(device)


def loop_weights(depths, offsets):
    out = []
    for start, end in zip(offsets.tolist(), offsets[1:].tolist()):
        ray = depths[start:end].tolist()
        out += [math.exp(-math.fsum(ray[:i])) * -math.expm1(-tau) for i, tau in enumerate(ray)]
    return torch.tensor(out, dtype=torch.float64)


def value_and_gradients(function, *arguments):
    """Gradients to all real arguments of a sum of squares."""
    arguments = [x.clone().requires_grad_() if x is not None and x.is_floating_point() else x for x in arguments]
    out = function(*arguments)
    inputs = [x for x in arguments if x is not None and x.requires_grad]
    return out.detach(), *torch.autograd.grad((out**2).sum(), inputs)


def test_reference_equals_loop(reference):
    depths, values, weights, offsets = packed(COUNTS)
    torch.testing.assert_close(packed_weights(depths, offsets), loop_weights(depths, offsets))
    pairs = list(zip(offsets.tolist(), offsets[1:].tolist()))
    expected = torch.stack([sum((weights[i] * values[i] for i in range(a, b)), values.new_zeros(3)) for a, b in pairs])
    torch.testing.assert_close(packed_sum(values, weights, offsets), expected)


@settings(max_examples=20, deadline=None)
@given(
    counts=st.lists(st.integers(0, 60), max_size=8), scale=st.sampled_from([0.0, 1e-9, 0.1, 30.0]),
    num_columns=st.integers(1, 9), weighted=st.booleans(),
)  # fmt: skip
def test_numba_agrees_with_reference_on_random_rays(counts, scale, num_columns, weighted):
    depths, values, weights, offsets = packed(counts, scale, num_columns=num_columns)
    summing = (packed_sum, values, weights if weighted else None, offsets)
    for arguments in ((packed_weights, depths, offsets), summing):
        expected = under("reference", value_and_gradients, *arguments)
        torch.testing.assert_close(under("numba", value_and_gradients, *arguments), expected)


@pytest.mark.parametrize("counts", [COUNTS, (), (0, 0), (1,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_agrees_with_reference(compiled, counts, dtype):
    depths, values, weights, offsets = packed(counts, dtype=dtype, device=compiled)
    # Sums of up to 200 terms, rounded in another order; squares double the relative error.
    tolerance = 4e-5 if dtype == torch.float32 else 1e-12
    summing = ((packed_sum, values, w, offsets) for w in (weights, None))
    for arguments in ((packed_weights, depths, offsets), *summing):
        actual = value_and_gradients(*arguments)
        expected = under("reference", value_and_gradients, *arguments)
        torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("depth", [0.0, 1e-12, 1e-6, 1e-3, 0.49, 0.51, 1.0, 30.0, 1e6, math.inf])
def test_float32_opacity_of_one_sample_is_exact(compiled, depth):
    weights = packed_weights(torch.tensor([depth], device=compiled), torch.tensor([0, 1], device=compiled))
    assert weights.item() == pytest.approx(-math.expm1(-torch.tensor(depth).item()), rel=3e-7, abs=0)


@pytest.mark.parametrize("wall", [1e6, math.inf])
def test_opaque_wall_is_safe_in_value_and_gradient(compiled, wall):
    depths = torch.tensor([0.5, wall, 0.3, wall, 0.0, 0.2], device=compiled, requires_grad=True)
    weights = packed_weights(depths, torch.tensor([0, 5, 6], device=compiled))
    expected = torch.tensor([-math.expm1(-0.5), math.exp(-0.5), 0, 0, 0, -math.expm1(-0.2)])
    torch.testing.assert_close(weights.detach().cpu(), expected)
    (gradient,) = torch.autograd.grad(weights[[0, 2, 5]].sum(), depths)
    torch.testing.assert_close(gradient.cpu(), torch.tensor([math.exp(-0.5), 0, 0, 0, 0, math.exp(-0.2)]))


def test_many_long_rays_keep_float32_precision(compiled):
    num_rays = 2000 if compiled == "cuda" else 20
    depths, _, _, offsets = packed([512] * num_rays, 2.5 / 512, torch.float32)
    weights = packed_weights(depths.to(compiled), offsets.to(compiled)).cpu()
    # The sum of 512 rounded depths that reach 1.25.
    torch.testing.assert_close(weights.double(), loop_weights(depths.double(), offsets), rtol=5e-6, atol=0)


def test_zero_density_shows_nothing_and_has_a_gradient(compiled):
    depths = torch.zeros(3, device=compiled, requires_grad=True)
    weights = packed_weights(depths, torch.tensor([0, 3], device=compiled))
    assert not weights.any()
    assert torch.autograd.grad(weights.sum(), depths)[0].tolist() == [1, 1, 1]


def test_empty_ray_gives_zero_and_values_without_columns_sums_without_columns(compiled):
    _, values, weights, offsets = packed((2, 0, 1), device=compiled)
    columns = packed_sum(values, weights, offsets)
    assert columns[1].tolist() == [0, 0, 0]
    torch.testing.assert_close(packed_sum(values[:, 1], weights, offsets), columns[:, 1])


def test_gradcheck(compiled):
    depths, values, weights, offsets = packed((0, 3, 1, 5), 2.0, num_columns=2, device=compiled)
    depths[1], depths[4] = 0.0, 40.0
    depths, values, weights = (x.requires_grad_() for x in (depths, values, weights))
    assert torch.autograd.gradcheck(lambda d: packed_weights(d, offsets), depths)
    assert torch.autograd.gradcheck(lambda v, w: packed_sum(v, w, offsets), (values, weights))


def test_half_precision_is_widened():
    ones, offsets = torch.ones(600, dtype=torch.bfloat16, requires_grad=True), torch.tensor([0, 600])
    sums = packed_sum(ones, None, offsets)
    assert sums.item() == 600
    for out in (sums, packed_weights(ones, offsets)):
        assert out.dtype == torch.float32
        assert torch.autograd.grad(out.sum(), ones)[0].dtype == torch.bfloat16


@pytest.mark.parametrize(("call", "message"), [
    (lambda d, v, w, o: packed_weights(d[:, None], o), r"optical_depth must have shape \(N,\), got \(4, 1\)"),
    (lambda d, v, w, o: packed_weights(d, o.int()), "offsets must be int64"),
    (lambda d, v, w, o: packed_weights(d[:3], o), "offsets must run from 0 to 3, got 0 to 4"),
    (lambda d, v, w, o: packed_sum(v, w[:3], o), r"weights must have shape \(4,\), got \(3,\)"),
    (lambda d, v, w, o: packed_sum(v[None], w, o), "values must have shape"),
    (lambda d, v, w, o: packed_sum(v[:3], None, o), "offsets must run from 0 to 3, got 0 to 4"),
])  # fmt: skip
def test_wrong_arguments_are_refused(call, message):
    with kernels.use_backend("numba"), pytest.raises(ValueError, match=message):
        call(*packed((4,)))
