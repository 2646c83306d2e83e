"""Solvers against closed-form flow maps: orders, tolerances, torchdiffeq, and the cases that must fail clearly."""

import itertools
import math

import pytest
import torch
from torch import Tensor
from torchdiffeq import odeint

from benchmarks.closed_flows import CLOSED_FLOWS, Expansion, Rotation, Swirl, count_evaluations
from dnerf.deformations import FlowDeformation, IntegrationError
from dnerf.deformations.solvers import ADAPTIVE_SOLVERS, FIXED_SOLVERS, SOLVERS, Solver, fixed_steps
from dnerf.deformations.velocities import Velocity

CANONICAL = 0.5
every_field = pytest.mark.parametrize("field", CLOSED_FLOWS)
every_solver = pytest.mark.parametrize("solver", SOLVERS)


def points(count: int = 40) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    positions = torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2 - 1
    return positions, torch.rand(count, generator=generator, dtype=torch.float64)


def error(flow: FlowDeformation, *, backwards: bool = False) -> float:
    positions, times = points()
    middle = torch.full_like(times, CANONICAL)
    if backwards:
        exact = flow.velocity.carry(positions, middle, times)
        return float((flow.reverse(positions, times) - exact).norm(dim=-1).max())
    return float((flow(positions, times) - flow.velocity.carry(positions, times, middle)).norm(dim=-1).max())


@every_field
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(("solver", "steps"), [("euler", 128), ("midpoint", 32), ("rk4", 8)])
def test_fixed_steps_have_their_order(field: str, solver: str, steps: int, backwards: bool) -> None:
    errors = [
        error(FlowDeformation(CLOSED_FLOWS[field](), CANONICAL, solver=solver, num_steps=n), backwards=backwards)
        for n in (steps, 2 * steps, 4 * steps)
    ]
    orders = [math.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)]
    expected = FIXED_SOLVERS[solver]
    # A rule may do better on a field (a shear is a quadrature: the last step's order is that of Simpson's rule);
    # worse by a tenth is the next order's share at these steps.
    assert orders[-1] > expected - 0.1
    assert orders[-1] < expected + 1.1


@every_field
@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("solver", ADAPTIVE_SOLVERS)
def test_adaptive_error_follows_the_tolerance(field: str, solver: str, backwards: bool) -> None:
    found = []
    for tolerance in (1e-3, 1e-5):
        flow = FlowDeformation(
            CLOSED_FLOWS[field](), CANONICAL, solver=solver, rtol=tolerance, atol=tolerance, max_steps=100000
        )
        evaluations = count_evaluations(flow, flow, *points())
        found.append((error(flow, backwards=backwards), evaluations))
    # The tolerance bounds the error of one step; the steps of one time unit add up, and grow with the map.
    assert found[0][0] < 100 * 1e-3
    assert found[1][0] < 100 * 1e-5
    # Where one step meets both (dopri8), no more evaluations are made.
    assert found[1][1] >= found[0][1]


@every_field
@pytest.mark.parametrize(("solver", "steps"), [("midpoint", 256), ("rk4", 32), ("dopri5", 1)])
def test_gradients_are_those_of_the_closed_form(field: str, solver: str, steps: int) -> None:
    velocity = CLOSED_FLOWS[field]()
    flow = FlowDeformation(velocity, CANONICAL, solver=solver, num_steps=steps, rtol=1e-8, atol=1e-9)
    inputs = [x.requires_grad_() for x in points()]

    def gradients(carried: Tensor) -> tuple[Tensor, ...]:
        return torch.autograd.grad((carried * torch.tensor([1.0, -2.0, 0.5])).square().sum(), inputs)

    exact = gradients(velocity.carry(*inputs, torch.full_like(inputs[1], CANONICAL)))
    for found, expected in zip(gradients(flow(*inputs)), exact):
        # The solver's error: 256 midpoints miss by up to 3e-5 of the largest, the others by less.
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


@pytest.mark.parametrize("solver", FIXED_SOLVERS)
@pytest.mark.parametrize("steps", [1, 3, 8])
def test_fixed_steps_are_those_of_torchdiffeq(solver: str, steps: int) -> None:
    field = Swirl()
    positions, times = points()

    def slope(s: float | Tensor, x: Tensor) -> Tensor:
        return (CANONICAL - times)[:, None] * field(x, times + s * (CANONICAL - times))

    grid = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    theirs = odeint(slope, positions, grid, method=solver)[-1]
    # Equal up to the rounding of a few hundred operations.
    torch.testing.assert_close(fixed_steps(solver, slope, positions, steps), theirs, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("solver", "per_step"), FIXED_SOLVERS.items())
def test_evaluations_are_counted(solver: str, per_step: int) -> None:
    flow = FlowDeformation(Rotation(), solver=solver, num_steps=5)
    positions, times = points()
    for carry in (flow, flow.reverse):
        assert count_evaluations(flow, carry, positions, times) == 5 * per_step


def test_adaptive_evaluations_are_counted_and_bounded() -> None:
    flow = FlowDeformation(Rotation(), solver="dopri5", rtol=1e-6, atol=1e-6)
    # Six evaluations per step and one to begin with.
    assert 13 <= count_evaluations(flow, flow, *points()) <= 200


@every_solver
def test_no_way_to_go_changes_nothing(solver: str) -> None:
    positions, _ = points()
    flow = FlowDeformation(Swirl(), CANONICAL, solver=solver)
    times = torch.full((len(positions),), CANONICAL, dtype=torch.float64)
    assert torch.equal(flow(positions, times), positions)
    assert torch.equal(flow.inverse(positions, times), positions)


@every_solver
def test_no_points_are_no_problem(solver: str) -> None:
    flow = FlowDeformation(Swirl(), solver=solver)
    assert flow(torch.zeros(0, 3), torch.zeros(0)).shape == (0, 3)


class Stiff(Velocity):
    """Everything falls onto the x axis within 1e-6 of time, and slides along it."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return -1e6 * (positions - torch.sin(3 * times)[..., None])


class Explosion(Velocity):
    """v = 1000 |p|^2 p, infinite after a time of 1 / (2000 |p|^2)."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return 1e3 * positions * positions.square().sum(-1, keepdim=True)


class Spike(Velocity):
    """Not finite within 0.01 of time 0.25; fast waves elsewhere, so that no solver steps over it."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        spike = ((times - 0.25).abs() < 1e-2)[..., None]
        return torch.where(spike, torch.nan, torch.sin(60 * times)[..., None].expand(positions.shape))


class Singular(Velocity):
    """v = 1 / |t - 0.25|, which no step can cross."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        return (1 / (times - 0.25).abs())[..., None].expand(positions.shape)


class OneIsHard(Velocity):
    """Points above z = 2 turn fifty times as fast as the rest."""

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        x, y, z = positions.unbind(-1)
        rate = torch.where(z > 2, 50.0, 1.0)
        return torch.stack([-rate * y, rate * x, torch.zeros_like(z)], dim=-1)


def way(times: float, count: int = 8) -> tuple[Tensor, Tensor]:
    return points(count)[0], torch.full((count,), times, dtype=torch.float64)


def test_stiff_field_is_given_up_with_advice() -> None:
    flow = FlowDeformation(Stiff(), 0.0, solver="dopri5", max_steps=50)
    with pytest.raises(IntegrationError, match=r"max_num_steps.* at time \d.*e-0[56] .*raise rtol and atol") as caught:
        flow.reverse(*way(1.0))
    assert "dopri5" in str(caught.value)


def test_explosion_of_fixed_steps_names_the_point_and_the_time() -> None:
    positions, times = way(1.0)
    positions[:] *= 1e-3
    positions[3] = 1.0
    flow = FlowDeformation(Explosion(), 0.0, solver="rk4", num_steps=8)
    with pytest.raises(IntegrationError, match=r"not finite at time 0\.\d+ \(point 3 of 8.*take more steps"):
        flow.reverse(positions, times)


def test_explosion_of_an_adaptive_solver_ends() -> None:
    flow = FlowDeformation(Explosion(), 0.0, solver="dopri5", max_steps=200)
    with pytest.raises(IntegrationError, match=r"the solver stopped .* at time 0\.00"):
        flow.reverse(*way(1.0))


@pytest.mark.parametrize("solver", ["rk4", "dopri5"])
def test_spike_names_its_time(solver: str) -> None:
    # 128 steps put a stage of rk4 on 0.25 itself.
    flow = FlowDeformation(Spike(), 0.0, solver=solver, num_steps=128)
    with pytest.raises(IntegrationError, match=r"at time 0\.(2[456])"):
        flow(*way(1.0))


def test_step_size_underflow_names_its_time() -> None:
    flow = FlowDeformation(Singular(), 0.0, solver="dopri5", rtol=1e-8, atol=1e-10, max_steps=100000)
    with pytest.raises(IntegrationError, match=r"underflow in dt.*at time 0\.25\b.*keep the velocity small and smooth"):
        flow(*way(1.0))


@pytest.mark.parametrize("solver", ["dopri5", "rk4"])
def test_one_hard_point_among_ten_thousand_is_right_and_spoils_no_other(solver: str) -> None:
    positions = points(10000)[0]
    positions[1234] = torch.tensor([0.5, 0.0, 3.0])
    times = torch.ones(10000, dtype=torch.float64)
    flow = FlowDeformation(OneIsHard(), 0.0, solver=solver, num_steps=8)
    moved = flow(positions, times)
    others = torch.arange(10000) != 1234
    exact = Rotation(1.0).carry(positions, times, 0 * times)
    torch.testing.assert_close(moved[others], exact[others], rtol=0, atol=1e-4)
    if solver == "dopri5":
        # rtol = 1e-5 over eight turns; a mean over the batch would let this one be wrong by its whole size.
        hard = Rotation(50.0).carry(positions[1234], times[0], 0 * times[0])
        torch.testing.assert_close(moved[1234], hard, rtol=0, atol=1e-2)


def test_expanding_field_is_followed_far() -> None:
    positions, times = way(1.0)
    flow = FlowDeformation(Expansion(10.0), 0.0, solver="dopri5", rtol=1e-6, atol=1e-9)
    grown = flow.reverse(positions, times)
    torch.testing.assert_close(grown, positions * math.exp(10.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(flow(grown, times), positions, rtol=0, atol=1e-3)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"name": "rk5"}, "solver must be one of euler, midpoint, rk4"),
    ({"num_steps": 0}, "num_steps must be > 0"),
    ({"rtol": 0.0}, "rtol must be > 0"), ({"max_steps": 0}, "max_steps must be > 0"),
])  # fmt: skip
def test_bad_solver_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Solver(**arguments)
