"""Flows in a row: closed forms of two that do not commute, inverses, and what a chain can bend before it folds."""

import pytest
import torch
from torch import Tensor

from benchmarks.closed_flows import Expansion, Rotation, Shear, count_evaluations
from dnerf.deformations import FlowChain, FlowDeformation, IdentityDeformation
from dnerf.deformations.inversion import jacobians
from dnerf.deformations.velocities import NetworkVelocity, Velocity

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def stationary(velocity: Velocity, solver: str = "rk4", num_steps: int = 16) -> FlowDeformation:
    return FlowDeformation(velocity, None, velocity_in_time="stationary", solver=solver, num_steps=num_steps)


def chain(*velocities: Velocity, solver: str = "rk4", num_steps: int = 16) -> FlowChain:
    return FlowChain({f"flow_{i}": stationary(velocity, solver, num_steps) for i, velocity in enumerate(velocities)})


def points(count: int = 50) -> tuple[Tensor, Tensor]:
    return torch.rand(count, 3, dtype=torch.float64) - 0.5, torch.rand(count, dtype=torch.float64)


def trained(seed: int, solver: str = "euler") -> FlowChain:
    torch.manual_seed(seed)
    velocities = [NetworkVelocity(BOX, 2, 16, position_frequencies=1, time_frequencies=1) for _ in range(2)]
    for velocity in velocities:
        assert velocity.mlp.output is not None
        torch.nn.init.normal_(velocity.mlp.output.weight, std=0.03)
    return chain(*velocities, solver=solver, num_steps=1).double()


def test_the_first_flow_comes_first() -> None:
    """Two linear fields that do not commute: the product of their matrix exponentials, in order."""
    rotation, shear = Rotation(1.2), Shear(0.8, 0.0)
    positions, times = points()
    matrices = []
    for velocity in (rotation, shear):
        columns = velocity(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
        matrices.append(torch.linalg.matrix_exp(columns.mT))
    expected = positions @ (matrices[1] @ matrices[0]).mT
    torch.testing.assert_close(chain(rotation, shear)(positions, times), expected, rtol=0, atol=1e-5)
    swapped = positions @ (matrices[0] @ matrices[1]).mT
    torch.testing.assert_close(chain(shear, rotation)(positions, times), swapped, rtol=0, atol=1e-5)
    assert (expected - swapped).abs().max() > 0.1


def test_one_field_twice_is_twice_the_way() -> None:
    positions, times = points()
    once = stationary(Expansion(0.6))(positions, times)
    torch.testing.assert_close(chain(Expansion(0.3), Expansion(0.3))(positions, times), once, rtol=0, atol=1e-7)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("solver", ["euler", "midpoint"])
def test_round_trips_return_although_each_flow_takes_one_step(seed: int, solver: str) -> None:
    deformation = trained(seed, solver)
    positions, times = points(200)
    canonical = deformation(positions, times)
    assert (canonical - positions).norm(dim=-1).max() > 0.05
    back = deformation.inverse(canonical, times)
    torch.testing.assert_close(back, positions, rtol=0, atol=1e-9)
    # The reverse solve alone misses by the steps' errors.
    assert (deformation.reverse(canonical, times) - positions).norm(dim=-1).max() > 1e-7


def test_gradients_are_those_of_finite_differences() -> None:
    deformation = trained(3)
    positions, times = points(3)
    inputs = (positions.requires_grad_(), times.requires_grad_())
    assert torch.autograd.gradcheck(deformation, inputs)
    assert torch.autograd.gradcheck(deformation.inverse, inputs, atol=1e-4)


def test_a_chain_bends_more_than_one_flow_before_it_folds() -> None:
    """One Euler step of v = -1.2 x turns space inside out; two that go half the way leave 0.4 of it each."""
    positions, times = points(4)
    one = jacobians(stationary(Expansion(-1.2), "euler", 1), positions, times)
    two = jacobians(chain(Expansion(-0.6), Expansion(-0.6), solver="euler", num_steps=1), positions, times)
    torch.testing.assert_close(torch.linalg.det(one), torch.full((4,), -(0.2**3), dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(two), torch.full((4,), 0.16**3, dtype=torch.float64))


def test_evaluations_of_all_flows_count() -> None:
    deformation = FlowChain({"coarse": stationary(Rotation(), "euler", 2), "fine": stationary(Shear(), "midpoint", 3)})
    assert count_evaluations(deformation, deformation, *points()) == 8
    assert isinstance(deformation.flows["coarse"].velocity, Rotation)  # as it was


def test_what_is_no_chain_is_refused() -> None:
    with pytest.raises(ValueError, match="flows must be at least one, got none"):
        FlowChain({})
    with pytest.raises(ValueError, match="flows must be FlowDeformation, got IdentityDeformation for still"):
        FlowChain({"still": IdentityDeformation()})
