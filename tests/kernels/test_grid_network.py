"""A network on a grid's features in one kernel against one part after the other."""

import itertools

import pytest
import torch
from kernels.backends import under
from torch import Tensor

from dnerf.kernels import GridLevels, grid_encode, grid_network
from dnerf.kernels.grid_network import grid_network_reference, is_fused

precisions = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
LEVELS = GridLevels([3, (5, 6, 7), 20], 512)  # the last one is hashed


def network(widths: tuple[int, ...], seed: int = 0) -> tuple[list[Tensor], list[Tensor]]:
    generator = torch.Generator().manual_seed(seed)
    weights = [torch.randn(b, a, generator=generator) / a**0.5 for a, b in itertools.pairwise(widths)]
    return weights, [torch.randn(b, generator=generator) for b in widths[1:]]


def places(count: int) -> Tensor:
    """In the unit cube, and some outside."""
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 1.2 - 0.1


def table(num_features: int) -> Tensor:
    return torch.randn(LEVELS.num_rows, num_features, generator=torch.Generator().manual_seed(2))


def exact(positions: Tensor, rows: Tensor, weights: list[Tensor], biases: list[Tensor], dtype: torch.dtype) -> Tensor:
    """In double precision, rounded where the definition is."""
    hidden = grid_encode(positions.double(), rows.double(), LEVELS).to(dtype).double()
    weights, biases = ([p.to(dtype).double() for p in parameters] for parameters in (weights, biases))
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        hidden = (hidden @ weight.T + bias).clamp(min=0).to(dtype).double()
    return hidden @ weights[-1].T + biases[-1]


@precisions
@pytest.mark.usefixtures("served")
@pytest.mark.parametrize("count", [0, 1, 11, 256, 257, 700])
@pytest.mark.parametrize(
    ("num_features", "widths"),
    [(8, (64, 64, 4)), (2, (16, 1)), (4, (128, 16, 16)), (8, (64, 28)), (2, (16, 49)), (4, (32, 76))],
)
def test_it_is_one_part_after_the_other(count: int, num_features: int, widths: tuple, dtype: torch.dtype) -> None:
    rows, parameters = table(num_features), network((3 * num_features, *widths))
    positions = places(count)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        found = grid_network(positions, rows, LEVELS, *parameters)
        chain = grid_network_reference(positions, rows, LEVELS, *parameters)
    assert found.shape == chain.shape == (count, widths[-1])
    assert found.dtype == torch.float32
    expected = exact(positions, rows, *parameters, dtype)
    if count:
        # Of what is between layers, the last bit may be another. In float32 sums are as exact as their order.
        most, ratio = (2e-2, 1.05) if dtype == torch.bfloat16 else (5e-6, 10)
        assert float((found - expected).abs().max()) < most * float(expected.abs().max())
        assert float((found - expected).pow(2).mean()) <= float((chain - expected).pow(2).mean()) * ratio


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_without_autocast_nothing_is_rounded(backend: str) -> None:
    rows, (weights, biases) = table(2), network((6, 16, 3))
    positions = places(50)
    found = under(backend, grid_network, positions, rows, LEVELS, weights, biases)
    hidden = torch.relu(grid_encode(positions, rows, LEVELS) @ weights[0].T + biases[0])
    torch.testing.assert_close(found, hidden @ weights[1].T + biases[1])


@precisions
@pytest.mark.usefixtures("served")
def test_other_sizes_and_dtypes_take_the_chain(dtype: torch.dtype) -> None:
    for widths, is_served in (((3, 16, 4), False), ((6, 12, 4), False), ((6, 16, 4), True)):
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            assert is_fused(places(3), widths[0], network(widths)[0]) == is_served
    rows, (weights, biases) = table(2).double(), network((6, 16, 4))
    double = [[p.double() for p in parameters] for parameters in (weights, biases)]
    assert grid_network(places(30).double(), rows, LEVELS, *double).dtype == torch.float64


@precisions
@pytest.mark.usefixtures("served")
def test_nan_stays_in_its_row(dtype: torch.dtype) -> None:
    rows, parameters = table(8), network((24, 64, 64, 4))
    positions = places(300)
    positions[17, 1] = torch.nan
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        found = grid_network(positions, rows, LEVELS, *parameters)
    assert bool(found[17].isnan().all())
    assert bool(found[[i for i in range(300) if i != 17]].isfinite().all())


def test_shapes_that_do_not_fit_are_refused() -> None:
    for axes, num_features, num_layers, message in (
        (3, 2, 1, "at least two layers"),
        (3, 3, 2, r"first weights must have shape \(n, 9\)"),
        (2, 2, 2, "positions must have shape"),
    ):
        parameters = (x[:num_layers] for x in network((6, 16, 4)))
        with pytest.raises(ValueError, match=message):
            grid_network(places(3)[:, :axes], table(num_features), LEVELS, *parameters)
