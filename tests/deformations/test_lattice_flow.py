"""The flow seen through a lattice: exact at vertices, close in between, cheap where samples share cells."""

import pytest
import torch

from dnerf.benchmarks.closed_flows import Rotation, Swirl
from dnerf.deformations import FlowDeformation, LatticeFlow

BOX = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))


def test_vertices_are_carried_exactly() -> None:
    flow = FlowDeformation(Swirl(), 0.0)
    seen = LatticeFlow(flow, BOX, 4, 3)
    positions, times = seen.lattice.place(torch.arange(3 * seen.lattice.num_vertices))
    # Read through a table whose stacked positions are rounded to float32.
    torch.testing.assert_close(seen(positions, times), flow(positions, times), rtol=0, atol=1e-4)


def test_error_falls_with_the_square_of_the_spacing() -> None:
    flow = FlowDeformation(Swirl(), 0.0, num_steps=16)
    positions, times = torch.rand(300, 3).double() * 2 - 1, torch.rand(300).double()
    exact = flow(positions, times)
    errors = [(LatticeFlow(flow, BOX, 8 * k, 8 * k + 1)(positions, times) - exact).norm(dim=-1).mean() for k in (1, 2)]
    # Linear interpolation: a factor of four, up to how points fall into cells.
    assert 3 < errors[0] / errors[1] < 5


def test_only_touched_vertices_are_integrated() -> None:
    seen = LatticeFlow(FlowDeformation(Rotation(), 0.0), BOX, 16, 17, pad_to=1)
    positions = 0.01 * torch.rand(1000, 3) + 0.05
    seen(positions, torch.full((1000,), 0.53))
    assert seen.num_vertices == 16


def test_padding_does_not_change_the_result() -> None:
    flow = FlowDeformation(Swirl(), 0.0)
    positions, times = torch.rand(50, 3), torch.rand(50)
    plain, padded = (LatticeFlow(flow, BOX, 8, 9, pad_to=pad)(positions, times) for pad in (1, 4096))
    torch.testing.assert_close(plain, padded, rtol=0, atol=1e-6)


def test_nothing_to_carry() -> None:
    seen = LatticeFlow(FlowDeformation(Rotation(), 0.0), BOX, 4, 3)
    assert seen(torch.zeros(0, 3), torch.zeros(0)).shape == (0, 3)
    assert seen.inverse(torch.zeros(0, 3), torch.zeros(0)).shape == (0, 3)


@pytest.mark.parametrize("name", ["pad_to", "num_iterations"])
def test_bad_settings_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be > 0"):
        LatticeFlow(FlowDeformation(Rotation(), 0.0), BOX, 4, 3, **{name: 0})


def test_half_precision_finds_the_same_cells() -> None:
    """Knots times layers have no room in bfloat16; what is left is the rounding of positions and of what is added."""
    seen = LatticeFlow(FlowDeformation(Rotation(), 0.0), BOX, 16, 17)
    positions = (torch.rand(2000, 3) * 2 - 1).bfloat16()
    times = torch.rand(2000).bfloat16()
    located = seen.lattice.locate(positions, times)
    exact = seen.lattice.locate(positions.float(), times.float())
    assert all(torch.equal(a, b) for a, b in zip(located, exact, strict=True))
