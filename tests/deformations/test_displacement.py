"""The D-NeRF deformation: a displacement that vanishes at the canonical time."""

import math

import pytest
import torch

from dnerf.core.geometry import move_by_twists
from dnerf.deformations import DisplacementDeformation, SE3Deformation


def trained(**arguments: object) -> DisplacementDeformation:
    deformation = DisplacementDeformation(3, 16, (1,), **arguments)
    for parameter in deformation.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return deformation


@pytest.mark.parametrize("canonical_time", [0.0, 0.5, 1.0])
def test_canonical_time_is_the_identity_after_any_training(canonical_time: float) -> None:
    deformation = trained(canonical_time=canonical_time)
    positions = torch.randn(20, 3)
    assert torch.equal(deformation(positions, torch.full((20,), canonical_time)), positions)
    assert not torch.equal(deformation(positions, torch.full((20,), 0.25)), positions)


def test_displacement_is_the_network_times_the_elapsed_time() -> None:
    deformation = trained(canonical_time=0.25)
    positions, times = torch.randn(20, 3), torch.rand(20)
    free = trained(canonical_time=None)
    free.load_state_dict(deformation.state_dict())
    offsets = free(positions, times) - positions
    expected = positions + (times - 0.25)[:, None] * offsets
    torch.testing.assert_close(deformation(positions, times), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("canonical_time", [-0.1, 1.1, math.nan])
def test_canonical_time_outside_the_film_is_refused(canonical_time: float) -> None:
    with pytest.raises(ValueError, match=r"canonical_time must be in \[0, 1\] or None"):
        DisplacementDeformation(2, 8, (), canonical_time=canonical_time)


def test_a_twist_that_is_the_same_everywhere_is_one_rigid_motion() -> None:
    deformation = SE3Deformation(2, 16, (), canonical_time=0.25).double()
    twist = torch.tensor([0.4, -0.5, 0.6, 0.1, 0.2, 0.3], dtype=torch.float64)
    with torch.no_grad():
        deformation.mlp.output.bias += twist
    positions = torch.randn(20, 3, dtype=torch.float64)
    moved = deformation(positions, torch.full((20,), 0.75, dtype=torch.float64))
    torch.testing.assert_close(moved, move_by_twists((0.5 * twist).expand(20, 6), positions), rtol=0, atol=1e-13)
