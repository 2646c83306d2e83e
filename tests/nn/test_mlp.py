"""The MLP against a loop over its layers, and its start."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dnerf.nn.mlp import MLP


def forward_by_loop(mlp: MLP, inputs: Tensor, skips: tuple[int, ...]) -> Tensor:
    """Evaluate one row after the other, one neuron after the other."""
    rows = []
    for row in inputs:
        x = row
        for i, layer in enumerate(mlp.hidden):
            if i in skips:
                x = torch.cat([x, row])
            x = torch.stack([(w * x).sum() + b for w, b in zip(layer.weight, layer.bias)]).clamp(min=0)
        if mlp.output is not None:
            x = torch.stack([(w * x).sum() + b for w, b in zip(mlp.output.weight, mlp.output.bias)])
        rows.append(x)
    return torch.stack(rows)


@pytest.mark.parametrize("skips", [(), (1,), (1, 3)])
@pytest.mark.parametrize("out_features", [None, 2])
def test_network_agrees_with_a_loop(skips: tuple[int, ...], out_features: int | None) -> None:
    mlp = MLP(3, 5, 4, out_features=out_features, skips=skips).double()
    for parameter in mlp.parameters():
        torch.nn.init.normal_(parameter)
    inputs = torch.randn(6, 3, dtype=torch.float64)
    torch.testing.assert_close(mlp(inputs), forward_by_loop(mlp, inputs, skips), rtol=1e-12, atol=1e-12)
    assert mlp(inputs).shape[-1] == mlp.out_features


def test_no_hidden_layers_is_one_linear_map() -> None:
    mlp = MLP(3, 5, 0, out_features=2)
    a, b = torch.randn(2, 4, 3)
    torch.testing.assert_close(mlp(a) + mlp(b) - mlp(torch.zeros(4, 3)), mlp(a + b))
    assert MLP(3, 5, 0).out_features == 3


def test_zero_output_is_zero_and_learns() -> None:
    mlp = MLP(3, 16, 2, out_features=3, zero_output=True)
    out = mlp(torch.randn(10, 3))
    assert torch.count_nonzero(out) == 0
    out.sum().backward()
    assert torch.count_nonzero(mlp.output.weight.grad) > 0  # type: ignore[union-attr]


def test_hidden_activations_keep_their_scale_at_the_start() -> None:
    out = MLP(64, 256, 8)(torch.randn(1000, 64))
    # He initialisation keeps the mean square of a ReLU network; eight random layers wander by less than 2.
    assert 0.5 < out.square().mean().item() < 2


def test_any_batch_shape_passes() -> None:
    mlp = MLP(3, 4, 2, out_features=1, skips=(1,))
    assert mlp(torch.zeros(2, 0, 3)).shape == (2, 0, 1)
    assert mlp(torch.zeros(3)).shape == (1,)


@pytest.mark.parametrize("skips", [(0,), (4,), (-1,), (2, 9)])
def test_skips_that_name_no_layer_are_refused(skips: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"skips must lie in 1\.\.3"):
        MLP(3, 5, 4, skips=skips)


@pytest.mark.parametrize(("sizes", "name"), [((0, 5, 4), "in_features"), ((3, 0, 4), "hidden_"), ((3, 5, -1), "num_")])
def test_sizes_that_are_not_positive_are_refused(sizes: tuple[int, int, int], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        MLP(*sizes)


@pytest.mark.parametrize(("activation", "formula"), [
    ("relu", lambda x: x.clamp(min=0)), ("silu", lambda x: x / (1 + torch.exp(-x))),
    ("softplus", lambda x: torch.log1p(torch.exp(x))),
])  # fmt: skip
def test_activation_is_its_formula(activation: str, formula: Callable[[Tensor], Tensor]) -> None:
    mlp = MLP(3, 8, 2, out_features=2, activation=activation).double()
    inputs = torch.randn(10, 3, dtype=torch.float64)
    hidden = inputs
    for layer in mlp.hidden:
        hidden = formula(layer(hidden))
    assert mlp.output is not None
    torch.testing.assert_close(mlp(inputs), mlp.output(hidden))


def test_unknown_activation_is_refused() -> None:
    with pytest.raises(ValueError, match="activation must be one of relu, silu, softplus; got 'tanh'"):
        MLP(3, 5, 4, activation="tanh")


@pytest.mark.parametrize("options", [{}, {"skips": (1,)}, {"activation": "silu"}, {"num_layers": 0}])
def test_scales_multiply_inputs(options: dict) -> None:
    mlp = MLP(**{"in_features": 3, "hidden_features": 8, "num_layers": 3, "out_features": 2, **options}).double()
    inputs, scale = torch.randn(7, 3, dtype=torch.float64), torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    scaled = (inputs * scale).requires_grad_()
    inputs.requires_grad_()
    found, expected = mlp(inputs, scale), mlp(scaled)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    mine, theirs = (
        torch.autograd.grad(output.square().sum(), [start, *mlp.parameters()])
        for output, start in ((found, inputs), (expected, scaled))
    )
    torch.testing.assert_close(mine[0], theirs[0] * scale, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(mine[1:], theirs[1:], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("size", [2, 6])
def test_another_number_of_inputs_is_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"inputs must have 5 columns, got {size}"):
        MLP(5, 8, 1)(torch.zeros(7, size))
