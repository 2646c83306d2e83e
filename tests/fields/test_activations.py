"""Density activations: positive, finite in value and gradient far beyond where exp overflows."""

import math

import pytest
import torch

from dnerf.fields.activations import DENSITY_ACTIVATIONS, activate_density, truncated_exp


@pytest.mark.parametrize("raw", [-80.0, -20.0, -1.0, 0.0, 3.0, 14.0])
@pytest.mark.parametrize("shift", [0.0, -1.0])
def test_densities_have_their_formula(raw: float, shift: float) -> None:
    tensor = torch.tensor(raw, dtype=torch.float64)
    softplus, exponential = (activate_density(tensor, name, shift).item() for name in ("softplus", "exp"))
    # torch's softplus is log(1 + exp(x)) to the last digits only relative to its size.
    assert softplus == pytest.approx(math.log1p(math.exp(raw + shift)), rel=1e-9)
    assert exponential == pytest.approx(math.exp(raw + shift), rel=1e-14)


def test_truncated_exp_pulls_beyond_its_clamp() -> None:
    x = torch.tensor([1.0, 15.0, 20.0, 100.0], requires_grad=True)
    value = truncated_exp(x)
    value.sum().backward()
    expected = torch.tensor([1.0, 15.0, 15.0, 15.0]).exp()
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(x.grad, expected)


def test_gradcheck_of_activations() -> None:
    raw = torch.tensor([-5.0, 0.0, 3.0, 8.0], dtype=torch.float64, requires_grad=True)
    for activation in DENSITY_ACTIVATIONS:
        assert torch.autograd.gradcheck(lambda x: activate_density(x, activation, -1.0), (raw,))  # noqa: B023


@pytest.mark.parametrize("activation", DENSITY_ACTIVATIONS)
@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_half_precision_is_raised_before_the_activation(activation: str, half: torch.dtype) -> None:
    raw = torch.tensor([-9.0, 0.5, 12.0], dtype=half)
    density = activate_density(raw, activation, -1.0)
    assert density.dtype == torch.float32
    assert torch.equal(density, activate_density(raw.float(), activation, -1.0))


def test_nan_is_not_hidden() -> None:
    for activation in DENSITY_ACTIVATIONS:
        assert torch.isnan(activate_density(torch.tensor(math.nan), activation, 0.0))


def test_unknown_activation_is_named() -> None:
    with pytest.raises(ValueError, match="activation must be one of softplus, exp; got 'relu'"):
        activate_density(torch.zeros(1), "relu", 0.0)
