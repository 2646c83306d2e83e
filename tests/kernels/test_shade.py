"""Density and colour of a network's last products."""

import pytest
import torch

from dnerf.fields.activations import activate_density
from dnerf.kernels import shade


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 255, 256, 600])
def test_it_is_what_the_activations_make_of_the_sums(dtype: torch.dtype, count: int) -> None:
    raw, bias = (5 * torch.randn(count, 4)).to(dtype), torch.randn(4)
    raw[::50, 0] = 40  # truncated
    density, rgb = shade(raw, bias, -1.5)
    values = raw.double() + bias.double()
    assert density.dtype == rgb.dtype == torch.promote_types(dtype, torch.float32)
    torch.testing.assert_close(density.double(), activate_density(values[:, 0], "exp", -1.5), rtol=5e-6, atol=0)
    torch.testing.assert_close(rgb.double(), torch.sigmoid(values[:, 1:]), rtol=2e-6, atol=1e-30)


@pytest.mark.usefixtures("backend")
def test_extreme_numbers() -> None:
    raw = torch.tensor([[torch.inf] * 4, [-torch.inf] * 4, [torch.nan] * 4, [0.0] * 4])
    density, rgb = shade(raw, torch.zeros(4), 0.0)
    torch.testing.assert_close(density, torch.tensor([15.0, -torch.inf, torch.nan, 0]).exp(), equal_nan=True)
    torch.testing.assert_close(rgb, torch.tensor([1.0, 0, torch.nan, 0.5])[:, None].expand(4, 3), equal_nan=True)


def test_wrong_shapes_are_named() -> None:
    for columns, size, message in ((3, 4, r"raw .* \(N, 4\), got \(2, 3\)"), (4, 3, "bias must have shape")):
        with pytest.raises(ValueError, match=message):
            shade(torch.zeros(2, columns), torch.zeros(size), 0.0)
