import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import packed_weights


def packed(counts, scale=0.3, dtype=torch.float64, seed=0):
    offsets = torch.tensor([0, *counts]).cumsum(0)
    depths = torch.rand(int(offsets[-1]), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (depths * scale).to(dtype), offsets


def loop_weights(depths, offsets):
    out = []
    for start, end in zip(offsets.tolist(), offsets[1:].tolist()):
        ray = depths[start:end].tolist()
        out += [math.exp(-math.fsum(ray[:i])) * -math.expm1(-tau) for i, tau in enumerate(ray)]
    return torch.tensor(out, dtype=torch.float64)


def value_and_gradient(depths, offsets, grad):
    depths = depths.clone().requires_grad_()
    weights = packed_weights(depths, offsets)
    return weights.detach(), *torch.autograd.grad(weights, depths, grad)


COUNTS = (0, 3, 1, 0, 200, 17, 0)


def test_reference_equals_loop(reference):
    depths, offsets = packed(COUNTS)
    torch.testing.assert_close(packed_weights(depths, offsets), loop_weights(depths, offsets))


@settings(max_examples=20, deadline=None)
@given(counts=st.lists(st.integers(0, 60), max_size=8), scale=st.sampled_from([0.0, 1e-9, 0.1, 30.0]))
def test_numba_agrees_with_reference_on_random_rays(counts, scale):
    depths, offsets = packed(counts, scale)
    grad = torch.randn(len(depths), dtype=torch.float64)
    with kernels.use_backend("reference"):
        expected = value_and_gradient(depths, offsets, grad)
    with kernels.use_backend("numba"):
        torch.testing.assert_close(value_and_gradient(depths, offsets, grad), expected)


@pytest.mark.parametrize("counts", [COUNTS, (), (0, 0), (1,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_agrees_with_reference(compiled, counts, dtype):
    depths, offsets = (x.to(compiled) for x in packed(counts, dtype=dtype))
    grad = torch.randn(len(depths), dtype=dtype).to(compiled)
    actual = value_and_gradient(depths, offsets, grad)
    with kernels.use_backend("reference"):
        expected = value_and_gradient(depths, offsets, grad)
    # Sums of up to 200 optical depths, rounded in another order.
    tolerance = 2e-5 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("depth", [0.0, 1e-12, 1e-6, 1e-3, 0.49, 0.51, 1.0, 30.0, 1e6, math.inf])
def test_float32_opacity_of_one_sample_is_exact(compiled, depth):
    weights = packed_weights(torch.tensor([depth], device=compiled), torch.tensor([0, 1], device=compiled))
    exact = -math.expm1(-torch.tensor(depth).item())
    assert weights.item() == pytest.approx(exact, rel=3e-7, abs=0)


@pytest.mark.parametrize("wall", [1e6, math.inf])
def test_opaque_wall_is_safe_in_value_and_gradient(compiled, wall):
    depths = torch.tensor([0.5, wall, 0.3, wall, 0.0, 0.2], device=compiled, requires_grad=True)
    offsets = torch.tensor([0, 5, 6], device=compiled)
    weights = packed_weights(depths, offsets)
    torch.testing.assert_close(
        weights.detach().cpu(),
        torch.tensor([-math.expm1(-0.5), math.exp(-0.5), 0, 0, 0, -math.expm1(-0.2)]),
    )
    (gradient,) = torch.autograd.grad(weights[[0, 2, 5]].sum(), depths)
    torch.testing.assert_close(gradient.cpu(), torch.tensor([math.exp(-0.5), 0, 0, 0, 0, math.exp(-0.2)]))


def test_many_long_rays_keep_float32_precision(compiled):
    num_rays = 2000 if compiled == "cuda" else 20
    depths, offsets = packed([512] * num_rays, 2.5 / 512, torch.float32)
    exact = loop_weights(depths.double(), offsets)
    weights = packed_weights(depths.to(compiled), offsets.to(compiled)).cpu()
    # The sum of 512 rounded depths that reach 1.25.
    torch.testing.assert_close(weights.double(), exact, rtol=5e-6, atol=0)


def test_zero_density_shows_nothing_and_has_a_gradient(compiled):
    depths = torch.zeros(3, device=compiled, requires_grad=True)
    weights = packed_weights(depths, torch.tensor([0, 3], device=compiled))
    assert not weights.any()
    (gradient,) = torch.autograd.grad(weights.sum(), depths)
    assert gradient.tolist() == [1, 1, 1]


def test_gradcheck(compiled):
    depths, offsets = packed((0, 3, 1, 5), 2.0)
    depths[1], depths[4] = 0.0, 40.0
    depths = depths.to(compiled).requires_grad_()
    assert torch.autograd.gradcheck(lambda d: packed_weights(d, offsets.to(compiled)), depths)


def test_half_precision_is_widened():
    depths, offsets = packed((4,), dtype=torch.bfloat16)
    weights = packed_weights(depths.requires_grad_(), offsets)
    assert weights.dtype == torch.float32
    assert torch.autograd.grad(weights.sum(), depths)[0].dtype == torch.bfloat16


def test_wrong_arguments_are_refused():
    depths, offsets = packed((4,))
    with pytest.raises(ValueError, match=r"optical_depth must have shape \(N,\), got \(4, 1\)"):
        packed_weights(depths[:, None], offsets)
    with pytest.raises(ValueError, match="offsets must be int64"):
        packed_weights(depths, offsets.int())
    with (
        kernels.use_backend("numba"),
        pytest.raises(ValueError, match="offsets must run from 0 to 3, got 0 to 4"),
    ):
        packed_weights(depths[:3], offsets)


def test_opcheck(compiled):
    depths, offsets = (x.to(compiled) for x in packed((2, 0, 3)))
    torch.library.opcheck(torch.ops.dnerf.packed_weights.default, (depths.requires_grad_(), offsets))
    arguments = (depths.detach(), depths.detach(), depths.detach(), offsets)
    torch.library.opcheck(torch.ops.dnerf.packed_weights_grad.default, arguments)


def test_compiles_without_graph_breaks():
    depths, offsets = packed(COUNTS)
    depths.requires_grad_()

    def loss(depths):
        return (packed_weights(depths * 2, offsets) ** 2).sum()

    (expected,) = torch.autograd.grad(loss(depths), depths)
    (actual,) = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend="aot_eager")(depths), depths)
    torch.testing.assert_close(actual, expected)
