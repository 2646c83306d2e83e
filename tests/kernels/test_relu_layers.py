"""Fused layers against layer after layer."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor, nn

from dnerf.kernels import has_bfloat16, relu_layers, use_backend
from dnerf.kernels.cpu.dense import cpu_features, is_supported
from dnerf.kernels.relu_layers import relu_layers_reference

fused = pytest.mark.skipif(not has_bfloat16("cpu"), reason="this CPU has no products in bfloat16")


def layers(*widths: int, seed: int = 0) -> nn.ModuleList:
    torch.manual_seed(seed)
    return nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))


def parameters(network: nn.ModuleList) -> tuple[list[Tensor], list[Tensor]]:
    return [layer.weight for layer in network], [layer.bias for layer in network]  # type: ignore[misc]


def under_autocast(backend: str, inputs: Tensor, network: nn.ModuleList) -> Tensor:
    with use_backend(backend), torch.autocast("cpu", torch.bfloat16):
        return relu_layers(inputs, *parameters(network))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 7, 253, 600])
@pytest.mark.parametrize("widths", [(3, 5, 4), (5, 48, 16), (6, 64, 64)])
def test_without_autocast_nothing_is_rounded(count: int, widths: tuple[int, ...], dtype: torch.dtype) -> None:
    network, inputs = layers(*widths).to(dtype), torch.randn(count, widths[0], dtype=dtype)
    hidden = (inputs @ network[0].weight.T + network[0].bias).clamp(min=0)
    expected = (hidden @ network[1].weight.T + network[1].bias).clamp(min=0)
    for function in (relu_layers_reference, relu_layers, torch.no_grad()(relu_layers)):
        torch.testing.assert_close(function(inputs, *parameters(network)), expected)


@fused
@pytest.mark.parametrize("shape", [(), (0,), (1,), (7,), (64,), (2, 0), (3, 5), (4096,)])
@pytest.mark.parametrize("widths", [(3, 8), (32, 128, 128, 128, 128), (40, 64, 64), (5, 17, 3)])
def test_fused_agrees_forward_and_backward(shape: tuple[int, ...], widths: tuple[int, ...]) -> None:
    network = layers(*widths)
    plain, quick = (torch.randn(*shape, widths[0], generator=torch.Generator().manual_seed(1)) for _ in range(2))
    found = []
    for backend, inputs in (("reference", plain), ("auto", quick)):
        network.zero_grad()
        inputs.requires_grad_()
        outputs = under_autocast(backend, inputs, network)
        outputs.float().square().sum().backward()
        found.append([outputs, inputs.grad, *(p.grad for p in network.parameters())])
    with torch.no_grad():
        assert torch.equal(under_autocast("auto", quick, network), found[1][0])
    for expected, got in zip(*found, strict=True):
        assert got.shape == expected.shape
        assert got.dtype == expected.dtype
        size = float(expected.detach().abs().max()) if expected.numel() else 0.0
        torch.testing.assert_close(got, expected, rtol=2e-2, atol=2e-2 * size)


@fused
def test_gradients_of_either_kind_may_be_left_out() -> None:
    network, inputs = layers(4, 16, 16), torch.randn(64, 4)
    under_autocast("auto", inputs, network).sum().backward()
    assert all(p.grad is not None for p in network.parameters())
    network.zero_grad()
    network.requires_grad_(False)
    inputs.requires_grad_()
    under_autocast("auto", inputs, network).sum().backward()
    assert inputs.grad is not None
    assert all(p.grad is None for p in network.parameters())


@fused
def test_second_derivatives_agree() -> None:
    network, found = layers(4, 32, 32), []
    for backend in ("reference", "auto"):
        inputs = torch.linspace(-1, 1, 64).reshape(16, 4).requires_grad_()
        outputs = under_autocast(backend, inputs, network).float().square().sum()
        (slope,) = torch.autograd.grad(outputs, inputs, create_graph=True)
        network.zero_grad()
        slope.square().sum().backward()
        found.append(network[0].weight.grad.clone())  # type: ignore[union-attr]
    torch.testing.assert_close(found[1], found[0], rtol=5e-2, atol=5e-2 * float(found[0].abs().max()))


@fused
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_not_finite_is_not_hidden(bad: float) -> None:
    network, inputs = layers(4, 32, 32, 32), torch.randn(9, 4)
    inputs[3, 1] = bad
    outputs = under_autocast("auto", inputs, network)
    assert not outputs[3].isfinite().all()
    assert outputs[torch.arange(9) != 3].isfinite().all()
    with torch.no_grad():
        network[0].weight[5, 2] = float("nan")
    assert not under_autocast("auto", inputs, network).isfinite().any()


@fused
def test_inputs_that_are_rounded_already_are_served_like_others() -> None:
    network, inputs = layers(40, 64, 64), torch.randn(300, 40)
    outputs, rounded = (under_autocast("auto", x, network) for x in (inputs, inputs.bfloat16()))
    assert torch.equal(outputs, rounded)
    below = int((outputs < 0).sum())  # as oneDNN leaves them: the definition has zeros there
    assert below == 0 if is_supported() else below > 1000


@pytest.mark.usefixtures("served")
@pytest.mark.parametrize("count", [0, 1, 5, 12, 13, 251, 252, 253, 600])
@pytest.mark.parametrize("widths", [(2, 16), (6, 48, 16), (40, 64, 64), (32, 128, 128, 128, 128), (64, 32, 96)])
def test_vectors_round_as_the_definition_does(count: int, widths: tuple[int, ...]) -> None:
    network, inputs = layers(*widths), torch.randn(count, widths[0], generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        found = under_autocast("auto", inputs, network)
    expected = inputs.bfloat16().double()
    for layer in network:
        weight, bias = (p.detach().bfloat16().double() for p in (layer.weight, layer.bias))
        expected = (expected @ weight.T + bias).clamp(min=0).bfloat16().double()
    assert found.shape == expected.shape
    # Products are exact and sums are not: of some outputs the last bit is another, which later layers see.
    torch.testing.assert_close(found.double(), expected, rtol=2.0**-7, atol=0.02 * len(network))


@pytest.mark.usefixtures("served")
def test_vectors_keep_nan_to_its_row_and_infinity() -> None:
    network, inputs = layers(40, 64, 64), torch.randn(300, 40)
    inputs[7, 3], inputs[20, 5] = torch.nan, torch.inf
    with torch.no_grad():
        first = under_autocast("auto", inputs, network[:1])
        found = under_autocast("auto", inputs, network)
    assert bool(first[7].isnan().all())
    assert set(first[20].tolist()) <= {0.0, torch.inf}
    assert (~found.isfinite().all(-1)).nonzero()[:, 0].tolist() in ([7], [7, 20])


@pytest.mark.usefixtures("served")
@pytest.mark.parametrize(("shapes", "message"), [(((32, 8), (16, 48)), "n, 32"), (((32, 6), (16, 32)), "n, 8")])
def test_layers_that_do_not_fit_are_refused(shapes: tuple[tuple[int, int], ...], message: str) -> None:
    weights, biases = [torch.zeros(s) for s in shapes], [torch.zeros(s[0]) for s in shapes]
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16), pytest.raises(ValueError, match=message):
        relu_layers(torch.zeros(20, 8), weights, biases)


def test_code_for_another_processor_does_without_vectors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("numba.config.CPU_NAME", "generic")
    assert not cpu_features.__wrapped__()


def test_a_processor_without_bfloat16_is_told_of_once(monkeypatch, caplog: pytest.LogCaptureFixture) -> None:
    """With AVX-512 alone oneDNN says that it has it, and emulates it."""
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: True)
    monkeypatch.setattr(torch.cpu, "_is_avx512_supported", lambda: True)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    has_bfloat16.cache_clear()
    with caplog.at_level("INFO"):
        assert [has_bfloat16("cpu"), has_bfloat16("cpu")] == [False, False]
    has_bfloat16.cache_clear()
    assert len(caplog.records) == 1
