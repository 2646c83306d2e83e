"""The flow that skips still regions: it learns which are still, and notices motion that begins."""

import pytest
import torch
from torch import Tensor

from dnerf.benchmarks.closed_flows import Rotation
from dnerf.deformations import FlowDeformation, SkippingFlow
from dnerf.deformations.velocities import Velocity

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class UpperHalfTurns(Velocity):
    """A turn about z above z = 0, nothing below."""

    def __init__(self) -> None:
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor(1.0))

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return torch.where(positions[..., 2:] > 0, self.rate * Rotation(1.0)(positions, times), 0.0)


def points(count: int = 2000) -> tuple[Tensor, Tensor]:
    return torch.rand(count, 3) * 2 - 1, torch.rand(count)


def looked_at(calls: int = 60) -> SkippingFlow:
    """A flow that has seen enough training samples for still cells to be known."""
    flow = SkippingFlow(FlowDeformation(UpperHalfTurns(), num_steps=2), BOX, 8, decay=0.8, pad_to=1)
    for _ in range(calls):
        flow(*points())
    return flow


def test_everything_is_integrated_at_first() -> None:
    flow = SkippingFlow(FlowDeformation(UpperHalfTurns()), BOX, 8)
    flow(*points())
    assert flow.num_integrated == 2000


def test_still_cells_are_skipped_and_moving_ones_are_not() -> None:
    flow = looked_at().eval()
    positions, times = points()
    assert torch.equal(flow(positions, times)[positions[:, 2] > 0], flow.flow(positions[positions[:, 2] > 0], times[
        positions[:, 2] > 0
    ]))  # fmt: skip
    assert torch.equal(flow(positions, times)[positions[:, 2] <= 0], positions[positions[:, 2] <= 0])
    # A layer of cells next to what moves is integrated as well: 5 of 8 layers, within the scatter of random points.
    assert 0.58 < flow.num_integrated / 2000 < 0.67


def test_some_samples_in_still_cells_are_tried_in_training() -> None:
    flow = looked_at()
    positions, times = points()
    positions[:, 2] = -0.8
    flow(positions, times)
    assert flow.num_integrated == 2000 / 8


def test_motion_that_begins_is_noticed() -> None:
    flow = looked_at()
    flow.flow.velocity = Rotation(1.0)
    positions, times = points()
    positions[:, 2] = -0.8
    flow(positions, times)
    flow.eval()
    moved = flow(positions, times)
    assert flow.num_integrated > 1900
    torch.testing.assert_close(moved, flow.flow(positions, times), rtol=0, atol=2e-3)


def test_round_trip_is_exact_to_the_threshold() -> None:
    flow = looked_at().eval()
    positions, times = points()
    torch.testing.assert_close(flow.inverse(flow(positions, times), times), positions, rtol=0, atol=flow.threshold)


def test_gradients_reach_the_velocity_through_what_is_integrated() -> None:
    flow = looked_at()
    flow(*points()).sum().backward()
    assert torch.isfinite(flow.flow.velocity.rate.grad)
    assert flow.flow.velocity.rate.grad != 0


def test_nothing_to_carry() -> None:
    assert looked_at(1)(torch.zeros(0, 3), torch.zeros(0)).shape == (0, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"decay": 1.0}, r"decay must be in \(0, 1\), got 1.0"),
        ({"threshold": 0.0}, "threshold must be > 0"),
        ({"explore_every": 0}, "explore_every must be > 0"),
    ],
)
def test_bad_settings_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SkippingFlow(FlowDeformation(Rotation()), BOX, **arguments)
