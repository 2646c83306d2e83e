"""The flow: round trips, Jacobians, gradients, composition, determinism."""

import copy

import pytest
import torch
from torch import Tensor

from benchmarks.closed_flows import Rotation, Swirl
from dnerf.deformations import DisplacementDeformation, FlowDeformation
from dnerf.deformations.velocities import NetworkVelocity, Velocity

BOX = ((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))


def points(count: int, dtype: torch.dtype = torch.float32, seed: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(count, 3, generator=generator, dtype=dtype) * 2 - 1
    return positions, torch.rand(count, generator=generator, dtype=dtype)


def fit(steps: int = 150) -> tuple[FlowDeformation, list[float]]:
    """A network flow trained by its displacements of points to follow a swirl."""
    torch.manual_seed(0)
    velocity = NetworkVelocity(BOX, 2, 32, position_frequencies=1, time_frequencies=2)
    flow = FlowDeformation(velocity, 0.0, solver="midpoint", num_steps=4)
    truth = Swirl(1.0, 3.0)
    optimizer = torch.optim.Adam(flow.parameters(), lr=1e-2)
    losses = []
    for step in range(steps):
        positions, times = points(256, seed=100 + step)
        target = truth.carry(positions, times, 0 * times)
        loss = (flow(positions, times) - target).square().sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return flow, losses


@pytest.fixture(scope="module")
def velocity() -> NetworkVelocity:
    flow, losses = fit()
    # It has learnt: points move by about half a unit, and miss by a tenth of that.
    assert losses[-1] < 0.1**2 * 0.5
    return flow.velocity


def flow_of(velocity: NetworkVelocity, dtype: torch.dtype = torch.float32, **arguments: object) -> FlowDeformation:
    arguments = {"solver": "rk4", "num_steps": 8, **arguments}
    return FlowDeformation(copy.deepcopy(velocity).to(dtype), **arguments)


@pytest.mark.parametrize("velocity_in_time", ["varying", "stationary"])
def test_round_trip_of_a_trained_field_in_float32(velocity: NetworkVelocity, velocity_in_time: str) -> None:
    flow = flow_of(velocity, canonical_time=0.0, velocity_in_time=velocity_in_time)
    positions, times = points(500)
    canonical = flow(positions, times)
    assert (canonical - positions).norm(dim=-1).mean() > 0.1
    # The target of the project; rounding alone is a few 1e-7 for coordinates up to 1.5.
    torch.testing.assert_close(flow.inverse(canonical, times), positions, rtol=0, atol=1e-6)
    torch.testing.assert_close(flow(flow.inverse(positions, times), times), positions, rtol=0, atol=1e-6)


def test_reverse_without_corrections_misses_by_the_solvers_error_only(velocity: NetworkVelocity) -> None:
    positions, times = points(500, torch.float64)
    misses = []
    for steps in (4, 8, 16):
        flow = flow_of(velocity, torch.float64, num_steps=steps)
        misses.append((flow.reverse(flow(positions, times), times) - positions).abs().max().item())
    # Order four or five: each halving of the step gains at least a factor of ten.
    assert misses[0] > 10 * misses[1] > 100 * misses[2]


def test_corrections_invert_few_coarse_steps(velocity: NetworkVelocity) -> None:
    positions, times = points(500)
    plain, corrected = (
        flow_of(velocity, solver="midpoint", num_steps=2, corrections=corrections) for corrections in (0, 10)
    )
    canonical = plain(positions, times)
    assert (plain.inverse(canonical, times) - positions).abs().max() > 1e-3
    torch.testing.assert_close(corrected.inverse(canonical, times), positions, rtol=0, atol=1e-6)


def test_each_correction_corrects(velocity: NetworkVelocity) -> None:
    positions, times = points(500)
    misses = []
    for corrections in (0, 1, 2, 4):
        flow = flow_of(velocity, solver="midpoint", num_steps=2, corrections=corrections)
        misses.append((flow.inverse(flow(positions, times), times) - positions).norm(dim=-1).mean().item())
    assert misses[0] > 2 * misses[1] > 4 * misses[2] > 8 * misses[3]


@pytest.mark.parametrize(
    ("velocity_in_time", "solver", "steps"), [("varying", "rk4", 8), ("stationary", "midpoint", 1)]
)
def test_jacobian_determinant_stays_positive(
    velocity: NetworkVelocity, velocity_in_time: str, solver: str, steps: int
) -> None:
    flow = flow_of(velocity, torch.float64, velocity_in_time=velocity_in_time, solver=solver, num_steps=steps)
    positions, times = points(500, torch.float64)
    assert determinants(flow, positions, times).min() > 0.05


class TwoSlopes(Velocity):
    """Expands by a rate about the origin, which it carries to (1, 0, 0), and contracts by it about (0.5, 0, 0)."""

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate

    def forward(self, positions: Tensor, times: Tensor) -> Tensor:
        shift = torch.tensor([1.0, 0.0, 0.0], dtype=positions.dtype)
        far = positions[..., :1] > 0.25
        return torch.where(far, -self.rate * (positions - 0.5 * shift), shift + self.rate * positions)


@pytest.mark.parametrize(("share", "folds"), [(0.99, False), (1.01, True)])
def test_one_midpoint_step_cannot_fold_below_the_stated_slope(share: float, folds: bool) -> None:
    """The worst case: det = (1 - L (1 + L / 2))^3 changes its sign at L = sqrt(3) - 1."""
    velocity = TwoSlopes(share * (3**0.5 - 1))
    flow = FlowDeformation(velocity, None, velocity_in_time="stationary", solver="midpoint", num_steps=1)
    origin, time = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    assert (determinants(flow, origin, time).item() < 0) == folds


def determinants(flow: torch.nn.Module, positions: Tensor, times: Tensor) -> Tensor:
    positions = positions.clone().requires_grad_()
    moved = flow(positions, times)
    rows = [torch.autograd.grad(moved[:, i].sum(), positions, retain_graph=True)[0] for i in range(3)]
    return torch.linalg.det(torch.stack(rows, dim=-2))


def test_jacobian_determinant_of_a_closed_flow_is_exact() -> None:
    positions, times = points(20, torch.float64)
    flow = FlowDeformation(Rotation(), 0.0, num_steps=32)
    torch.testing.assert_close(determinants(flow, positions, times), torch.ones_like(times), rtol=0, atol=1e-5)


def test_motion_composes_whatever_the_way(velocity: NetworkVelocity) -> None:
    flow = flow_of(velocity, torch.float64)
    positions, first = points(50, torch.float64)
    second, third = 1 - first, first.square()
    there = flow.inverse(flow(positions, first), second)
    on = flow.inverse(flow(there, second), third)
    torch.testing.assert_close(on, flow.inverse(flow(positions, first), third), rtol=0, atol=1e-9)


def test_stationary_and_varying_velocities_agree_where_the_velocity_does_not_change() -> None:
    positions, times = points(50, torch.float64)
    varying, stationary = (
        FlowDeformation(Rotation(), 0.3, velocity_in_time=kind, num_steps=32) for kind in ("varying", "stationary")
    )
    torch.testing.assert_close(varying(positions, times), stationary(positions, times), rtol=0, atol=1e-12)


def test_one_euler_step_of_a_stationary_velocity_is_a_displacement() -> None:
    torch.manual_seed(1)
    velocity = NetworkVelocity(BOX)
    torch.nn.init.normal_(velocity.mlp.output.weight)
    positions, times = points(50)
    displaced = FlowDeformation(velocity, None, velocity_in_time="stationary", solver="euler", num_steps=1)(
        positions, times
    )
    assert torch.equal(displaced, positions + velocity(positions, times))


def test_points_outside_the_box_stay_and_none_leaves_it(velocity: NetworkVelocity) -> None:
    flow = flow_of(velocity)
    positions = 4 * torch.rand(1000, 3) - 2
    times = torch.rand(1000)
    moved = flow(positions * 1.5, times)
    outside = (1.5 * positions).abs().amax(-1) >= 2
    assert torch.equal(moved[outside], 1.5 * positions[outside])
    assert moved[~outside].abs().max() <= 2


def test_gradcheck_of_the_inverse(velocity: NetworkVelocity) -> None:
    flow = flow_of(velocity, torch.float64, num_steps=2)
    canonical, times = points(1, torch.float64)
    assert torch.autograd.gradcheck(flow.inverse, (canonical.requires_grad_(), times.requires_grad_()), atol=1e-5)


def test_same_seed_gives_the_same_losses() -> None:
    first, second = fit(5)[1], fit(5)[1]
    assert first == second


def test_the_displacement_has_no_such_guarantee() -> None:
    """What the flow is for: a displacement may fold space where the flow of the same network does not."""
    torch.manual_seed(3)
    displacement = DisplacementDeformation(2, 32, (), position_frequencies=2, canonical_time=None).double()
    torch.nn.init.normal_(displacement.mlp.output.weight, std=0.4)
    positions, times = points(500, torch.float64)
    assert determinants(displacement, positions, times).min() < 0
    velocity = NetworkVelocity(BOX, 2, 32, position_frequencies=2).double()
    torch.nn.init.normal_(velocity.mlp.output.weight, std=0.4)
    flow = FlowDeformation(velocity, None, velocity_in_time="stationary", solver="rk4", num_steps=64)
    assert (flow(positions, times) - positions).norm(dim=-1).mean() > 0.3
    assert determinants(flow, positions, times).min() > 0


@pytest.mark.parametrize(("arguments", "message"), [
    ({"canonical_time": None}, "canonical_time must be a time in"),
    ({"canonical_time": 1.5}, r"canonical_time must be in \[0, 1\] or None, got 1.5"),
    ({"velocity_in_time": "stopped"}, "velocity_in_time must be one of varying, stationary"),
    ({"corrections": -1}, "corrections must be >= 0"), ({"solver": "magic"}, "solver must be one of"),
])  # fmt: skip
def test_bad_settings_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FlowDeformation(Rotation(), **arguments)
