import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dnerf import kernels
from dnerf.kernels import packed_sum


def packed(counts, num_columns=3, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    values = torch.randn(int(offsets[-1]), num_columns, generator=generator, dtype=dtype)
    return values, torch.rand(len(values), generator=generator, dtype=dtype), offsets


def value_and_gradients(values, weights, offsets, grad):
    values = values.clone().requires_grad_()
    inputs = [values] if weights is None else [values, weights.clone().requires_grad_()]
    sums = packed_sum(values, inputs[1] if len(inputs) > 1 else None, offsets)
    return sums.detach(), *torch.autograd.grad(sums, inputs, grad)


COUNTS = (0, 3, 1, 0, 100, 0)


def test_reference_equals_loop(reference):
    values, weights, offsets = packed(COUNTS)
    pairs = list(zip(offsets.tolist(), offsets[1:].tolist()))
    expected = torch.stack([sum((weights[i] * values[i] for i in range(a, b)), values.new_zeros(3)) for a, b in pairs])
    torch.testing.assert_close(packed_sum(values, weights, offsets), expected)


@settings(max_examples=20, deadline=None)
@given(
    counts=st.lists(st.integers(0, 60), max_size=8),
    num_columns=st.integers(1, 9),
    weighted=st.booleans(),
)
def test_numba_agrees_with_reference_on_random_rays(counts, num_columns, weighted):
    values, weights, offsets = packed(counts, num_columns)
    grad = torch.randn(len(counts), num_columns, dtype=torch.float64)
    arguments = (values, weights if weighted else None, offsets, grad)
    with kernels.use_backend("reference"):
        expected = value_and_gradients(*arguments)
    with kernels.use_backend("numba"):
        torch.testing.assert_close(value_and_gradients(*arguments), expected)


@pytest.mark.parametrize("counts", [COUNTS, (), (0, 0), (1,)])
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_agrees_with_reference(compiled, counts, weighted, dtype):
    values, weights, offsets = (x.to(compiled) for x in packed(counts, dtype=dtype))
    grad = torch.randn(len(counts), 3, dtype=dtype).to(compiled)
    arguments = (values, weights if weighted else None, offsets, grad)
    actual = value_and_gradients(*arguments)
    with kernels.use_backend("reference"):
        expected = value_and_gradients(*arguments)
    # Sums of up to 100 terms of size one, rounded in another order.
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    torch.testing.assert_close(actual, expected, rtol=tolerance, atol=tolerance)


def test_empty_ray_gives_zero(compiled):
    values, weights, offsets = (x.to(compiled) for x in packed((2, 0, 1)))
    assert packed_sum(values, weights, offsets)[1].tolist() == [0, 0, 0]


def test_values_without_columns_give_sums_without_columns(compiled):
    values, weights, offsets = (x.to(compiled) for x in packed(COUNTS))
    columns = packed_sum(values, weights, offsets)
    torch.testing.assert_close(packed_sum(values[:, 1], weights, offsets), columns[:, 1])


def test_gradcheck(compiled):
    values, weights, offsets = (x.to(compiled) for x in packed((0, 2, 1, 3), 2))
    inputs = (values.requires_grad_(), weights.requires_grad_())
    assert torch.autograd.gradcheck(lambda v, w: packed_sum(v, w, offsets), inputs)


def test_half_precision_is_summed_in_float32():
    values = torch.ones(600, dtype=torch.bfloat16, requires_grad=True)
    sums = packed_sum(values, None, torch.tensor([0, 600]))
    assert sums.dtype == torch.float32
    assert sums.item() == 600
    assert torch.autograd.grad(sums.sum(), values)[0].dtype == torch.bfloat16


def test_wrong_arguments_are_refused():
    values, weights, offsets = packed((4,))
    with pytest.raises(ValueError, match=r"weights must have shape \(4,\), got \(3,\)"):
        packed_sum(values, weights[:3], offsets)
    with pytest.raises(ValueError, match="values must have shape"):
        packed_sum(values[None], weights, offsets)
    with (
        kernels.use_backend("numba"),
        pytest.raises(ValueError, match="offsets must run from 0 to 3, got 0 to 4"),
    ):
        packed_sum(values[:3], None, offsets)


def test_opcheck(compiled):
    values, weights, offsets = (x.to(compiled) for x in packed((2, 0, 3)))
    inputs = (values.clone().requires_grad_(), weights.clone().requires_grad_(), offsets)
    torch.library.opcheck(torch.ops.dnerf.packed_sum.default, inputs)
    grad = torch.ones(3, 3, dtype=values.dtype, device=compiled)
    torch.library.opcheck(torch.ops.dnerf.packed_sum_grad_values.default, (grad, weights, offsets, 5))
    torch.library.opcheck(torch.ops.dnerf.packed_sum_grad_weights.default, (grad, values, offsets))


def test_compiles_without_graph_breaks():
    values, weights, offsets = packed(COUNTS)
    inputs = (values.requires_grad_(), weights.requires_grad_())

    def loss(values, weights):
        return (packed_sum(values * 2, weights, offsets) ** 2).sum()

    expected = torch.autograd.grad(loss(*inputs), inputs)
    actual = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend="aot_eager")(*inputs), inputs)
    torch.testing.assert_close(actual, expected)
